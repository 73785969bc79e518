"""Ctrl-C ends a command with exit code 130 and one message, and a setting of the environment gives no traceback."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from pathlib import Path
from time import sleep

import pytest
from springbench.harness.execution import interrupts
from springbench.harness.results import parquet_rows

ROOT = Path(__file__).resolve().parents[2]
SCENE = ROOT / "configs" / "scenes" / "hanging-cloth.yaml"
WAIT = 600.0
"""Seconds after which a command counts as hanging, on however busy a machine."""


def start(*arguments: str, **environment: str) -> subprocess.Popen[str]:
    """A command in a session of its own, as a terminal starts it."""
    return subprocess.Popen(
        [sys.executable, "-m", "springbench", *arguments],
        cwd=ROOT,
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell that starts these tests in the background makes its children ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def interrupt(process: subprocess.Popen[str], seconds: float) -> None:
    """Send Ctrl-C to all processes of the session after some seconds, and check how the command ends."""
    try:
        output, errors = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGINT)
        output, errors = process.communicate(timeout=WAIT)
        assert process.returncode == interrupts.INTERRUPT_EXIT_CODE, errors
        assert errors.count(interrupts.INTERRUPT_MESSAGE) == 1
        assert "Traceback" not in errors + output
    else:
        assert process.returncode == 0, errors
        assert seconds > 0.5


def wait_for_handler(process: subprocess.Popen[str]) -> None:
    """Wait until the command catches SIGALRM, which it does once its handler of Ctrl-C is installed."""
    status = Path(f"/proc/{process.pid}/status")
    while process.poll() is None:
        caught = next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("SigCgt"))
        if int(caught, 16) >> (signal.SIGALRM - 1) & 1:
            return
        sleep(0.001)


@pytest.mark.skipif(sys.platform != "linux", reason="which signals are caught is read from /proc")
@pytest.mark.parametrize("seconds", [0.001, 0.05])
def test_ctrl_c_while_modules_are_imported(seconds: float):
    process = start("list", "--results", "results")
    wait_for_handler(process)
    interrupt(process, seconds)


@pytest.mark.long
@pytest.mark.parametrize("where", [(), ("--scheduler", "local:2")], ids=["here", "dask"])
@pytest.mark.parametrize("seed", range(20))
def test_ctrl_c_at_a_random_moment(seed: int, where: tuple[str, ...], tmp_path: Path):
    sweep = tmp_path / "sweep.yaml"
    sweep.write_text(
        f"scenes: [{SCENE.name}]\nsizes: [8, 12]\nsolvers: [sparse, numba, hybrid]\noptions: {{frames: 10}}\n"
    )
    (tmp_path / SCENE.name).write_text(SCENE.read_text())
    process = start("run", str(sweep), "--results", str(tmp_path / "results"), *where)
    interrupt(process, random.Random(seed).uniform(0.3, 15.0))


def test_an_interrupt_that_a_destructor_swallows_is_raised_again():
    code = """
        import os, signal, time
        from springbench.harness.execution import interrupts
        from springbench.harness.results import parquet_rows

        class Swallows:
            def __del__(self):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(1)

        signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupts.install_handler()
        try:
            Swallows()
            time.sleep(20)
        except KeyboardInterrupt:
            print("interrupted")
        """
    lines = "\n".join(line[8:] for line in code.splitlines())
    done = subprocess.run([sys.executable, "-c", lines], cwd=ROOT, capture_output=True, text=True, timeout=WAIT)
    assert (done.stdout, done.stderr) == ("interrupted\n", "")


@pytest.mark.parametrize("value", ["x", "0", "-3", "1.5"])
def test_a_number_of_threads_without_a_meaning_is_refused(value: str):
    process = start("--version", NUMBA_NUM_THREADS=value)
    _, errors = process.communicate(timeout=WAIT)
    assert process.returncode == 2
    assert "NUMBA_NUM_THREADS" in errors
    assert "Traceback" not in errors


@pytest.mark.parametrize("arguments", [[], ["--csv"]])
def test_a_terminal_that_writes_ascii_alone_gets_escape_sequences(arguments: list[str], tmp_path: Path):
    (tmp_path / "sweep" / "rows").mkdir(parents=True)
    parquet_rows.write_rows(tmp_path / "sweep" / "rows" / "a.parquet", [{"sweep": "sweep", "seconds": 0.5}])
    process = start(
        *("query", "SELECT 'fl\u00e4che' AS name", "--results", str(tmp_path), *arguments),
        PYTHONIOENCODING="ascii",
        MPLBACKEND="none such",
    )
    output, errors = process.communicate(timeout=WAIT)
    assert process.returncode == 0, errors
    assert "fl\\xe4che" in output
