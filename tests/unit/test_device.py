"""`device: cuda` where there is none: a row with the reason and the remedy, and the sweep goes on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from harness.base import rows
from harness.cli import app
from harness.config.load import load_any
from harness.experiments.plan import Files
from tests.scenes import CLOTH_FILE

SWEEP = """
scenes: [cloth.yaml]
sizes: [3]
solvers: [{name: vbd, device: cuda}, vbd]
options: {iterations: 2, rounds: 1, frames: 1, threads: 1, pictures: false}
"""


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")  # where there is one it is not seen
    (tmp_path / "cloth.yaml").write_text(CLOTH_FILE)
    made = tmp_path / "sweep.yaml"
    made.write_text(SWEEP)
    return made


def test_without_a_device_a_run_is_refused_and_the_others_are_done(sweep: Path) -> None:
    told = CliRunner().invoke(app, ["run", str(sweep), "--results", str(sweep.parent / "r")])
    assert told.exit_code == 1, told.output
    found: list[dict[str, Any]] = []
    for run in load_any(sweep).runs():
        row = rows.first(Files.of(run, sweep.parent / "r" / "sweep").rows)
        assert isinstance(row, dict)
        found.append(row)
    here, there = found
    assert here["status"] == "unsupported"
    assert here["reason"].startswith("vbd: ")
    assert "`.venv/bin/pip install -e '.[cuda]'`" in here["reason"]
    assert (there["status"], there["device"], there["parameters"]) == ("ok", None, '{"spectral_radius": 0.999}')


def test_runs_on_the_processor_are_named_as_before_there_were_devices(sweep: Path) -> None:
    given = [run.solver.parameters for run in load_any(sweep).runs()]
    assert given == [{"device": "cuda", "spectral_radius": 0.999}, {"spectral_radius": 0.999}]


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("{name: vbd, device: gpu}", "'cpu' or 'cuda'"),
        ("{name: vbd, precision: float32}", "precision: float32 is for `device: cuda`"),
        ("{name: vbd, device: cuda, precision: float16}", "'float32' or 'float64'"),
    ],
)
def test_what_no_device_knows_is_refused(entry: str, said: str, sweep: Path) -> None:
    sweep.write_text(SWEEP.replace("{name: vbd, device: cuda}", entry))
    told = CliRunner().invoke(app, ["run", str(sweep), "--results", str(sweep.parent / "r")])
    assert told.exit_code == 2
    assert said in " ".join(told.output.split())
