"""One run: a failure leaves a row and nothing that would hide it."""

import math
from pathlib import Path

import pytest

from harness.base import machine
from harness.config.load import load_any
from harness.experiments import run
from harness.experiments.plan import Files
from harness.experiments.run import execute
from harness.record.reader import summary
from harness.simulation.measure import StepFailed
from harness.simulation.observe import require_numbers


def test_a_run_that_fails_now_keeps_nothing_of_when_it_did_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 2\ndefault_size: 3\neffects: [{kind: gravity}]\n"
    )
    (spec,) = load_any(tmp_path / "scene.yaml", solvers=["sparse"]).runs()
    files = Files.of(spec, tmp_path)
    files.rows.parent.mkdir()
    assert {row["status"] for row in execute(spec, files, lambda phase: None)} == {"ok"}
    files.picture.parent.mkdir()
    files.picture.touch()
    assert files.recording.exists()
    assert files.recording.name == f"{spec.label(machine.describe().id)}.rrd"

    def broken(*_):
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr(run, "measure", broken)
    (row,) = execute(spec, files, lambda phase: None)
    assert row["status"] == "failed"
    assert "ZeroDivisionError: nothing to divide by (test_run.py:" in row["reason"]
    assert not files.recording.exists()
    assert not files.picture.exists()
    assert files.rows.exists()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of NumPy, that something overflows: it is what is tested
@pytest.mark.parametrize("stretch", ["1e308", "1e300"])
@pytest.mark.parametrize("solver", ["sparse", "numba"])
def test_a_run_whose_residual_is_no_number_is_not_ok(tmp_path: Path, solver: str, stretch: str):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 2\ndefault_size: 3\neffects: [{kind: gravity}, "
        f"{{kind: springs, stretch: {stretch}}}, {{kind: pins, at: [first]}}]\n"
    )
    (spec,) = load_any(tmp_path / "scene.yaml", solvers=[solver]).runs()
    files = Files.of(spec, tmp_path)
    files.rows.parent.mkdir()
    for row in execute(spec, files, lambda phase: None):
        assert row["status"] != "ok" or all(math.isfinite(v) for v in row.values() if isinstance(v, float))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["residual", "objective", "stationarity", "energy_springs"])
def test_a_measured_column_that_is_no_number_fails_its_frame(name: str, value: float):
    columns = {1: {name: 0.0, "digest": "", "minimum": True}, 2: {name: value, "digest": "", "minimum": None}}
    with pytest.raises(StepFailed) as caught:
        require_numbers(columns, minimises=True, tolerance=True)
    assert caught.value.frame == 2
    assert run.failure(caught.value)["status"] == "diverged"
    assert run.failure(caught.value)["reason"].startswith(f"{name} is {value}")


@pytest.mark.parametrize("tolerance", [False, True])
def test_what_a_method_does_not_have_is_null_and_no_failure(tolerance: bool):
    columns = {1: {"residual": float("nan"), "yardstick": float("nan"), "objective": 1.0}}
    require_numbers(columns, minimises=False, tolerance=tolerance)
    assert columns == {1: {"residual": None, "yardstick": None, "objective": 1.0}}


@pytest.mark.parametrize("solver", ["xpbd", "symplectic-euler", "velocity-verlet", "ros2", "baraff-witkin"])
def test_a_method_that_minimises_nothing_may_be_asked_for_a_tolerance(tmp_path: Path, solver: str):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.01\nframes: 2\ndefault_size: 3\neffects: [{kind: gravity}, "
        "{kind: springs, stretch: 100}, {kind: pins, at: [first]}]\n"
    )
    (spec,) = load_any(tmp_path / "scene.yaml", solvers=[solver], tolerance=1e-6).runs()
    files = Files.of(spec, tmp_path)
    files.rows.parent.mkdir()
    found = execute(spec, files, lambda phase: None)
    assert {row["status"] for row in found} == {"ok"}, found[0]["reason"]
    assert all(row["residual"] is row["yardstick"] is None for row in found if row["phase"] == "step")


@pytest.mark.parametrize("solver", ["newton", "newton-cg", "pncg", "jgs2"])
def test_a_scene_at_rest_is_recorded_with_no_iterations(tmp_path: Path, solver: str):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 3\ndefault_size: 3\n"
        "effects: [{kind: springs, stretch: 10}]\n"
    )
    (spec,) = load_any(tmp_path / "scene.yaml", solvers=[solver], tolerance=1e-6).runs()
    files = Files.of(spec, tmp_path)
    files.rows.parent.mkdir()
    found = execute(spec, files, lambda phase: None)
    assert {row["status"] for row in found} == {"ok"}, found[0]["reason"]
    assert [row["iterations"] for row in found if row["phase"] == "step" and row["round"] == 0] == [0, 0, 0]
    assert summary(files.recording).complete
