"""What strangers' code does to the process that it runs in."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from pathlib import Path
from time import monotonic, sleep

from springbench.harness.execution.worker_process import ProgressCallback
from springbench.solvers.iteration.device_interface import record_device_loss


def double_number(number: int, tick: ProgressCallback) -> int:
    tick("doubling")
    return 2 * number


def worker_pid(tick: ProgressCallback) -> int:
    """Of the worker's process."""
    return os.getpid()


def crash_process(tick: ProgressCallback) -> None:
    tick("crashing")
    tick("crashing")
    ctypes.string_at(0)


def abort_process(tick: ProgressCallback) -> None:
    print("I cannot go on", file=sys.stderr)
    os.abort()


def exit_with_error(tick: ProgressCallback) -> None:
    os._exit(7)


def exit_cleanly(tick: ProgressCallback) -> None:
    os._exit(0)


def raise_system_exit(tick: ProgressCallback) -> None:
    sys.exit("I am off")


def raise_generator_exit(tick: ProgressCallback) -> None:
    raise GeneratorExit


def raise_keyboard_interrupt(tick: ProgressCallback) -> None:
    raise KeyboardInterrupt


def kill_process(tick: ProgressCallback) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def loop_forever(tick: ProgressCallback) -> None:
    while True:
        pass


def exhaust_memory(tick: ProgressCallback) -> int:
    return len([bytes(2**20) for _ in range(2**11)])


def break_device(tick: ProgressCallback) -> int:
    record_device_loss("an illegal address")
    return os.getpid()


def start_daemon_thread(tick: ProgressCallback) -> int:
    threading.Thread(target=sleep, args=(60.0,), daemon=True).start()
    return os.getpid()


def flood_stderr(tick: ProgressCallback) -> str:
    """More than any pipe buffers."""
    for _ in range(5000):
        print("x" * 99, file=sys.stderr)
        tick("chatting")
    return "said"


def fork_process(tick: ProgressCallback) -> int:
    """Make a copy of the process that goes on as if it were the worker."""
    child = os.fork()
    if child:
        os.waitpid(child, 0)
    return os.getpid()


def count_threads_after_recording(path: Path, tick: ProgressCallback) -> int:
    """The threads of this process after one more recording."""
    from tests.synthetic_recordings import write_recording

    write_recording(path, frame_count=2)
    return len(os.listdir("/proc/self/task"))


def time_logging(tick: ProgressCallback) -> float:
    """Processor-light steps that write 18 kB each; the wall seconds of one.

    It is the least mean of eight, which take more than two pipes of 64 kB: others may have the processor in between.
    """
    found = list[float]()
    for _ in range(25):
        began = monotonic()
        for _ in range(8):
            print("x" * 18_000)
        found.append((monotonic() - began) / 8)
    return min(found)


def start_orphans(how: str, tick: ProgressCallback) -> int:
    """Start a process that outlives this one, unless another process ends it; its number."""
    import subprocess

    if how == "a child":
        return subprocess.Popen(["sleep", "600"]).pid
    if how == "a session of its own":
        return subprocess.Popen(["sleep", "600"], start_new_session=True).pid
    forks = "child = os.fork(); print(child) if child else (os.setsid(), os.close(1), time.sleep(600))"
    shell = subprocess.run([sys.executable, "-c", f"import os, time; {forks}"], stdout=subprocess.PIPE, timeout=60)
    return int(shell.stdout)


def start_orphans_and_crash(how: str, path: Path, tick: ProgressCallback) -> None:
    path.write_text(str(start_orphans(how, tick)))
    ctypes.string_at(0)


def exhaust_memory_in_children(tick: ProgressCallback) -> None:
    """Four processes, each of them within the limit of one."""
    import subprocess

    program = "import time; taken = bytearray(200 * 2**20); time.sleep(600)"
    children = [subprocess.Popen([sys.executable, "-c", program]) for _ in range(4)]
    children[0].wait()


def close_file_descriptors(tick: ProgressCallback) -> None:
    os.closerange(0, 4096)


def change_folder(tick: ProgressCallback) -> None:
    os.chdir("/")


def current_folder(tick: ProgressCallback) -> str:
    return os.getcwd()
