"""One run: a failure leaves a row and nothing that would hide it."""

import math
from pathlib import Path

import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.execution import machine_info
from springbench.harness.experiments import run_pipeline
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.recording.recording_reader import summarise_recording
from springbench.harness.simulation import timing_pass
from springbench.harness.simulation.instrumentation_pass import require_finite
from springbench.harness.simulation.timing_pass import StepError


def test_a_run_that_fails_now_removes_its_earlier_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 2\ndefault_size: 3\neffects: [{kind: gravity}]\n"
    )
    (spec,) = load_config(tmp_path / "scene.yaml", solvers=["sparse"]).list_runs()
    files = RunFiles.for_run(spec, tmp_path)
    files.rows_path.parent.mkdir()
    assert {row["status"] for row in execute_run(spec, files, lambda phase: None)} == {"ok"}
    files.picture_path.parent.mkdir()
    files.picture_path.touch()
    assert files.recording_path.exists()
    assert files.recording_path.name == f"{spec.build_file_stem(machine_info.describe_machine().machine_id)}.rrd"

    def fail_run(*_):
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr(timing_pass, "measure_run", fail_run)
    (row,) = execute_run(spec, files, lambda phase: None)
    assert row["status"] == "failed"
    assert "ZeroDivisionError: nothing to divide by (test_run_pipeline.py:" in row["reason"]
    assert not files.recording_path.exists()
    assert not files.picture_path.exists()
    assert files.rows_path.exists()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of NumPy, that something overflows: it is what is tested
@pytest.mark.parametrize("stretch", ["1e308", "1e300"])
@pytest.mark.parametrize("solver", ["sparse", "numba"])
def test_a_run_whose_residual_is_no_number_is_not_ok(tmp_path: Path, solver: str, stretch: str):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 2\ndefault_size: 3\neffects: [{kind: gravity}, "
        f"{{kind: springs, stretch: {stretch}}}, {{kind: pins, parts: [first]}}]\n"
    )
    (spec,) = load_config(tmp_path / "scene.yaml", solvers=[solver]).list_runs()
    files = RunFiles.for_run(spec, tmp_path)
    files.rows_path.parent.mkdir()
    for row in execute_run(spec, files, lambda phase: None):
        assert row["status"] != "ok" or all(math.isfinite(v) for v in row.values() if isinstance(v, float))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["residual", "objective", "stationarity", "energy_springs"])
def test_a_measured_column_that_is_no_number_fails_its_frame(name: str, value: float):
    columns = {
        1: {name: 0.0, "positions_digest": "", "is_local_minimum": True},
        2: {name: value, "positions_digest": "", "is_local_minimum": None},
    }
    with pytest.raises(StepError) as caught:
        require_finite(columns, is_minimiser=True, has_rtol=True)
    assert caught.value.frame == 2
    assert run_pipeline.build_failure_columns(caught.value)["status"] == "diverged"
    assert run_pipeline.build_failure_columns(caught.value)["reason"].startswith(f"{name} is {value}")


@pytest.mark.parametrize("tolerance", [False, True])
def test_what_a_method_does_not_have_is_null_and_no_failure(tolerance: bool):
    columns = {1: {"residual": float("nan"), "residual_initial": float("nan"), "objective": 1.0}}
    require_finite(columns, is_minimiser=False, has_rtol=tolerance)
    assert columns == {1: {"residual": None, "residual_initial": None, "objective": 1.0}}


@pytest.mark.parametrize("solver", ["xpbd", "symplectic-euler", "velocity-verlet", "ros2", "baraff-witkin"])
def test_a_method_that_minimises_nothing_may_be_requested_a_tolerance(tmp_path: Path, solver: str):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.01\nframes: 2\ndefault_size: 3\neffects: [{kind: gravity}, "
        "{kind: springs, stretch: 100}, {kind: pins, parts: [first]}]\n"
    )
    (spec,) = load_config(tmp_path / "scene.yaml", solvers=[solver], rtol=1e-6).list_runs()
    files = RunFiles.for_run(spec, tmp_path)
    files.rows_path.parent.mkdir()
    found = execute_run(spec, files, lambda phase: None)
    assert {row["status"] for row in found} == {"ok"}, found[0]["reason"]
    assert all(row["residual"] is row["residual_initial"] is None for row in found if row["phase"] == "step")


@pytest.mark.parametrize("solver", ["newton", "newton-cg", "pncg", "jgs2"])
def test_a_scene_at_rest_is_recorded_with_no_iterations(tmp_path: Path, solver: str):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 3\ndefault_size: 3\n"
        "effects: [{kind: springs, stretch: 10}]\n"
    )
    (spec,) = load_config(tmp_path / "scene.yaml", solvers=[solver], rtol=1e-6).list_runs()
    files = RunFiles.for_run(spec, tmp_path)
    files.rows_path.parent.mkdir()
    found = execute_run(spec, files, lambda phase: None)
    assert {row["status"] for row in found} == {"ok"}, found[0]["reason"]
    assert [row["num_iterations"] for row in found if row["phase"] == "step" and row["round"] == 0] == [0, 0, 0]
    assert summarise_recording(files.recording_path).is_complete
