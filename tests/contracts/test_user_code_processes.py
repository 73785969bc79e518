"""User code runs in processes of its own: whatever it does there, every command says so and ends by its exit code."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from time import sleep

import pytest
from springbench.harness.cli.main import app
from springbench.harness.errors import RunFailed
from springbench.harness.execution.isolated_call import run_isolated
from springbench.harness.execution.worker_process import ProgressCallback, TaskLimits
from springbench.harness.report import accuracy_report
from typer.testing import CliRunner

USER_CODE = """
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from springbench.harness.scenes.effects.effect_interface import EffectContribution, build_constant_force
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal


def note(what):
    if os.getpid() == {command}:
        (Path(__file__).parent / "in-the-command").write_text(what)


note("import")


@dataclass(frozen=True)
class Mine:
    def prepare(self, system):
        note("prepare")
        return SparseLocalGlobal().prepare(system)


class Hum(ConfigModel):
    kind: Literal["hum"] = "hum"

    def build_contribution(self, mesh, mass, time_step):
        note("bind")
        with (Path(__file__).parent / "count").open("a") as count:
            count.write(".")
            if count.tell() >= {exits_at}:
                os._exit(0)
        force = 0.0 * mesh.rest_positions
        force[:, 0] = 0.1
        return EffectContribution(forces=build_constant_force(force))


class Cord(ChainMesh):
    kind: Literal["cord"] = "cord"

    def generate_mesh(self, size):
        note("mesh")
        return super().generate_mesh(size)
"""
FILES = {
    "odd.yaml": """
mesh: {kind: "./mine.py:Cord", length: 1.0}
mass: 1.0
time_step: 1/30
frames: 3
default_size: 3
effects: [{kind: springs, stretch: 200}, {kind: gravity}, {kind: pins, parts: [first]}, {kind: "./mine.py:Hum"}]
""",
    "accuracy.yaml": """
scenes: [odd.yaml]
solvers: ["./mine.py:Mine", sparse]
work: [{t_end: 0.1, max_iterations: 20}]
""",
    "sweep.yaml": """
scenes: [odd.yaml]
sizes: [3]
solvers: ["./mine.py:Mine", sparse]
options: {frames: 2, rounds: 2}
""",
}
COMMANDS = {
    "accuracy": "accuracy accuracy.yaml",
    "recommend": "recommend odd.yaml --error 0.9 --t-end 0.1 --search-time 10",
    "roofline": "roofline sweep.yaml --budget 0.1",
    "ablate": "ablate odd.yaml --rtol 0.1",
    "gallery": "gallery odd.yaml -o sheet.png",
    "run to an error": "run odd.yaml --error 0.1 --t-end 0.1",
    "preview": "preview odd.yaml -o picture.png",
}

DRAWING = ("accuracy", "roofline", "gallery")
"""Commands that draw pictures even so, or that import what draws them."""


def command(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, exits_at: float) -> tuple[int, str]:
    """Exit code and output of a command, whose effect ends its process in one of its bindings."""
    (folder / "mine.py").write_text(USER_CODE.format(command=os.getpid(), exits_at=exits_at))
    for file, text in FILES.items():
        (folder / file).write_text(text)
    monkeypatch.setattr(
        accuracy_report, "draw_chart_sheets", lambda *_: []
    )  # it draws rows, and runs nothing of a user
    monkeypatch.chdir(folder)
    found = CliRunner().invoke(app, COMMANDS[name].split())
    assert found.exception is None or isinstance(found.exception, SystemExit), found.output
    assert "Traceback" not in found.output
    assert (folder / "count").stat().st_size > 1, found.output[-3000:]
    assert not (folder / "in-the-command").exists(), (folder / "in-the-command").read_text()
    return found.exit_code, " ".join(found.output.split())


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in DRAWING else name for name in COMMANDS]
)
def test_user_code_that_exits_after_its_trial_ends_no_command(name: str, tmp_path: Path, monkeypatch):
    code, said = command(tmp_path, monkeypatch, name, exits_at=2)
    assert code in (1, 2)
    assert "exit code 0" in said


@pytest.mark.long
@pytest.mark.parametrize("name", COMMANDS)
def test_user_code_that_works_never_runs_in_the_command(name: str, tmp_path: Path, monkeypatch):
    code, said = command(tmp_path, monkeypatch, name, exits_at=1e9)
    assert code == 0, said


def hang(tick: ProgressCallback) -> None:
    while True:
        sleep(1.0)


def test_user_code_that_hangs_after_its_trial_is_stopped_at_the_time_limit():
    with pytest.raises(RunFailed, match=r"the process that runs ./mine.py:Hum did not end within 0.5 s"):
        run_isolated(hang, ["./mine.py:Hum"], TaskLimits(0.5))


STOPPED_WHILE_IMPORTING = """
import signal, subprocess, sys
from springbench.harness.execution.worker_supervisor import _Supervisor

blocked = []


class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "psutil":
            blocked.append(signal.SIGTERM in signal.pthread_sigmask(signal.SIG_BLOCK, ()))


sys.meta_path.insert(0, Watch())
child = subprocess.Popen(["sleep", "60"])
_Supervisor(0, 0, 0)._kill_descendants()
print(blocked, signal.SIGTERM in signal.pthread_sigmask(signal.SIG_BLOCK, ()), child.poll() is not None)
"""


def test_a_stop_of_a_supervisor_waits_until_its_import_is_complete():
    """The handler of the stop imports the same module, and would find a part of it."""
    completed = subprocess.run(
        [sys.executable, "-c", STOPPED_WHILE_IMPORTING], capture_output=True, text=True, timeout=100
    )
    assert completed.stdout == "[True] False True\n", completed.stderr
