"""The child that reads foreign input: it may hang, swell, crash or leave, and the next call is answered as before."""

from __future__ import annotations

import ctypes
import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from springbench.harness.atomic_files import WriteError, atomic_write, describe_os_error
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox

LIMITS, SHORT = sandbox.CallLimits(20.0, 2**27), sandbox.CallLimits(0.5, 2**27)
"""What ends by itself has time on a slow machine as well; what does not is ended soon."""


def double(number: int) -> int:
    return 2 * number


def loop() -> None:
    while True:
        pass


def swell() -> int:
    return len([bytes(2**20) for _ in range(2**10)])


def crash() -> None:
    ctypes.string_at(0)


def abort() -> None:
    os.abort()


def leave() -> None:
    sys.exit("I am off")


def end() -> None:
    os._exit(7)


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def panic() -> None:
    raise BaseException("index out of\nrange")


def refuse(path: Path) -> None:
    raise InputError(InputMistake("is odd", path, 3, "key"))


def half(path: Path) -> None:
    with atomic_write(path) as partial:
        partial.write_text("new")
        raise OSError(errno.ENOSPC, "the disk is full")


def list_modules() -> list[str]:
    return list(sys.modules)


def here() -> str:
    return os.getcwd()


def test_a_sandboxed_call_returns_its_result_and_prints_nothing(capfd: pytest.CaptureFixture[str]):
    assert sandbox.call_in_sandbox(double, 21, limits=LIMITS) == 42
    sandbox.call_in_sandbox(print, "noise", limits=LIMITS)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("function", "why"),
    [
        (loop, "takes more than 0.5 s"),
        (swell, "takes more than 0.1 GiB of memory"),
        (crash, "crashed (SIGSEGV)"),
        (abort, "crashed (SIGABRT)"),
        (leave, "I am off"),
        (end, "crashed (exit code 7)"),
        (kill, "was killed, as the system does when its memory runs out"),
        (panic, "index out of range"),
    ],
)
def test_a_failed_call_is_reported_in_words_and_the_next_call_succeeds(function, why):
    with pytest.raises(sandbox.SandboxError) as caught:
        sandbox.call_in_sandbox(function, limits=SHORT if function is loop else LIMITS)
    assert why in str(caught.value)
    assert sandbox.call_in_sandbox(double, 21, limits=LIMITS) == 42


def test_a_call_that_waits_is_reported_with_the_limit_of_wall_time():
    with pytest.raises(sandbox.SandboxError, match=r"takes more than 0\.5 s$"):
        sandbox.call_in_sandbox(time.sleep, 60.0, limits=sandbox.CallLimits(0.05, 2**27))
    assert sandbox.call_in_sandbox(double, 21, limits=LIMITS) == 42


def test_a_function_given_by_name_is_imported_in_the_sandbox_alone():
    """Preparation imports it there before the call."""
    assert "this" not in sys.modules
    sandbox.prepare_call("this:d")
    assert "this" in sandbox.call_in_sandbox(list_modules, limits=LIMITS)
    assert sandbox.call_in_sandbox("this:d.get", "A", limits=LIMITS) == "N"
    assert "this" not in sys.modules


def test_the_end_of_a_process_does_not_wait_for_a_prepared_call(tmp_path: Path):
    (tmp_path / "slow_import.py").write_text("import time\ntime.sleep(3.0)\nopen('imported', 'w').close()\n")
    program = "from springbench.harness.execution.sandbox import prepare_call; prepare_call('slow_import:time')"
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
    assert not (tmp_path / "imported").exists()


def test_a_mistake_comes_with_its_place(tmp_path: Path):
    with pytest.raises(InputError) as caught:
        sandbox.call_in_sandbox(refuse, tmp_path, limits=LIMITS)
    assert caught.value.mistakes == (InputMistake("is odd", tmp_path, 3, "key"),)


def test_relative_paths_refer_to_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert sandbox.call_in_sandbox(here, limits=LIMITS) == os.getcwd()


def test_a_file_takes_its_place_whole_or_not_at_all(tmp_path: Path):
    path = tmp_path / "a.txt"
    with atomic_write(path) as partial:
        partial.write_text("old")
    with pytest.raises(WriteError, match=r"a\.txt: cannot be written: No space left on device"):
        half(path)
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]


def test_an_error_of_the_system_names_its_files():
    assert describe_os_error(OSError(20, "Not a directory", "a", None, "b")) == "a and b: Not a directory"
