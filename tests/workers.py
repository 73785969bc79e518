"""What strangers' code does to the process that it runs in."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from pathlib import Path
from time import monotonic, sleep

from harness.base.worker import Tick
from solvers.device import broken


def double(number: int, tick: Tick) -> int:
    tick("doubling")
    return 2 * number


def name(tick: Tick) -> int:
    """Of the worker's process."""
    return os.getpid()


def crash(tick: Tick) -> None:
    tick("crashing")
    tick("crashing")
    ctypes.string_at(0)


def abort(tick: Tick) -> None:
    print("I cannot go on", file=sys.stderr)
    os.abort()


def leave(tick: Tick) -> None:
    os._exit(7)


def leave_well(tick: Tick) -> None:
    os._exit(0)


def leave_by_python(tick: Tick) -> None:
    sys.exit("I am off")


def leave_as_a_generator(tick: Tick) -> None:
    raise GeneratorExit


def interrupt(tick: Tick) -> None:
    raise KeyboardInterrupt


def be_killed(tick: Tick) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def loop(tick: Tick) -> None:
    while True:
        pass


def swell(tick: Tick) -> int:
    return len([bytes(2**20) for _ in range(2**11)])


def lose_the_device(tick: Tick) -> int:
    broken("an illegal address")
    return os.getpid()


def leave_a_thread(tick: Tick) -> int:
    threading.Thread(target=sleep, args=(60.0,), daemon=True).start()
    return os.getpid()


def chat(tick: Tick) -> str:
    """More than any pipe holds."""
    for _ in range(5000):
        print("x" * 99, file=sys.stderr)
        tick("chatting")
    return "said"


def copy(tick: Tick) -> int:
    """Make a copy of the process that goes on as if it were the worker."""
    child = os.fork()
    if child:
        os.waitpid(child, 0)
    return os.getpid()


def threads_after(path: Path, tick: Tick) -> int:
    """The threads of this process after one more recording."""
    from tests.recordings import record

    record(path, count=2)
    return len(os.listdir("/proc/self/task"))


def log_much(tick: Tick) -> float:
    """Processor-light steps that write 18 kB each; the wall seconds of one."""
    began = monotonic()
    for _ in range(200):
        print("x" * 18_000)
    return (monotonic() - began) / 200


def leave_processes(how: str, tick: Tick) -> int:
    """Start a process that outlives this one, unless somebody ends it; its number."""
    import subprocess

    if how == "a child":
        return subprocess.Popen(["sleep", "600"]).pid
    if how == "a session of its own":
        return subprocess.Popen(["sleep", "600"], start_new_session=True).pid
    forks = "child = os.fork(); print(child) if child else (os.setsid(), os.close(1), time.sleep(600))"
    shell = subprocess.run([sys.executable, "-c", f"import os, time; {forks}"], stdout=subprocess.PIPE, timeout=60)
    return int(shell.stdout)


def leave_processes_and_crash(how: str, path: Path, tick: Tick) -> None:
    path.write_text(str(leave_processes(how, tick)))
    ctypes.string_at(0)


def swell_in_children(tick: Tick) -> None:
    """Four processes, each of them within the limit of one."""
    import subprocess

    program = "import time; taken = bytearray(200 * 2**20); time.sleep(600)"
    children = [subprocess.Popen([sys.executable, "-c", program]) for _ in range(4)]
    children[0].wait()


def close_all_files(tick: Tick) -> None:
    os.closerange(0, 4096)


def leave_the_folder(tick: Tick) -> None:
    os.chdir("/")


def folder(tick: Tick) -> str:
    return os.getcwd()
