"""`device: cuda` where there is none: a row with the reason and the remedy, and the sweep goes on."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.results import parquet_rows
from springbench.harness.simulation.device_stepping import compute_event_seconds
from springbench.solvers.cuda import cuda_device
from springbench.solvers.iteration.device_interface import SolveEvents
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.position_based.xpbd import Xpbd
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.step_problem import Solver, Unsupported
from typer.testing import CliRunner

from tests.scene_builders import CLOTH_SCENE_YAML, build_cloth

SWEEP = """
scenes: [cloth.yaml]
sizes: [3]
solvers: [{name: vbd, device: cuda}, vbd]
options: {max_iterations: 2, rounds: 1, frames: 1, threads: 1, pictures: false}
"""


@pytest.fixture
def sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")  # where there is one it is not seen
    (tmp_path / "cloth.yaml").write_text(CLOTH_SCENE_YAML)
    made = tmp_path / "sweep.yaml"
    made.write_text(SWEEP)
    return made


def test_without_a_device_a_run_is_refused_and_the_others_are_done(sweep: Path) -> None:
    result = CliRunner().invoke(app, ["run", str(sweep), "--results", str(sweep.parent / "r")])
    assert result.exit_code == 1, result.output
    found: list[dict[str, Any]] = []
    for run in load_config(sweep).list_runs():
        row = parquet_rows.read_first_row(RunFiles.for_run(run, sweep.parent / "r" / "sweep").rows_path)
        assert isinstance(row, dict)
        found.append(row)
    here, there = found
    assert here["status"] == "unsupported"
    assert here["reason"].startswith("vbd: ")
    assert "`.venv/bin/pip install -e '.[cuda]'`" in here["reason"]
    assert (there["status"], there["device"], there["parameters"]) == ("ok", None, '{"spectral_radius": 0.999}')


@pytest.mark.parametrize(
    "solver",
    [VertexBlockDescent(device="cuda"), NewtonCG(preconditioner="schwarz", device="cuda"), Xpbd(device="cuda")],
    ids=["vbd", "newton-cg", "xpbd"],
)
def test_the_command_installs_all_that_a_method_needs(solver: Solver, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(package: str) -> str:
        raise PackageNotFoundError(package)

    monkeypatch.setattr(cuda_device, "version", missing)
    with pytest.raises(Unsupported, match=re.escape("`.venv/bin/pip install -e '.[cuda]'`")):
        solver.prepare(build_cloth(3).system)


def test_runs_on_the_processor_are_named_as_before_there_were_devices(sweep: Path) -> None:
    given = [run.solver.parameters for run in load_config(sweep).list_runs()]
    assert given == [{"device": "cuda", "spectral_radius": 0.999}, {"spectral_radius": 0.999}]


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("{name: vbd, device: gpu}", "'cpu' or 'cuda'"),
        ("{name: vbd, precision: float32}", "precision: float32 is for `device: cuda`"),
        ("{name: vbd, device: cuda, precision: float16}", "'float32' or 'float64'"),
        ("{name: lbfgs, device: cuda}", "device"),
    ],
)
def test_what_no_device_supports_is_refused(entry: str, said: str, sweep: Path) -> None:
    sweep.write_text(SWEEP.replace("{name: vbd, device: cuda}", entry))
    result = CliRunner().invoke(app, ["run", str(sweep), "--results", str(sweep.parent / "r")])
    assert result.exit_code == 2
    assert said in " ".join(result.output.split())


class At:
    """An event at so many milliseconds."""

    def __init__(self, when: float) -> None:
        self.when = when

    def elapsed_time(self, event: Any) -> float:
        return event.when - self.when


def test_events_distinguish_kernels_and_transfers() -> None:
    durations = compute_event_seconds(SolveEvents(At(1.0), At(3.0), At(10.0), At(10.5)))
    assert durations == pytest.approx({"kernel_seconds": 7e-3, "transfer_seconds": 2.5e-3})
    assert compute_event_seconds(None) == {}, "of a device without a clock nothing is told"


class NvmlRefusal(Exception):
    """As NVIDIA's management library refuses."""


@pytest.fixture
def nvml(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A management library that reports a clock and no power."""

    def refuses(*_: Any) -> float:
        raise NvmlRefusal

    made = SimpleNamespace(
        NVML_CLOCK_SM=1,
        NVML_CLOCK_MEM=2,
        NVML_TEMPERATURE_GPU=0,
        nvmlInit=lambda: None,
        nvmlShutdown=lambda: None,
        nvmlDeviceGetHandleByUUID=lambda uuid: uuid,
        nvmlDeviceGetClockInfo=lambda handle, kind: {"GPU-0": {1: 1980, 2: 2619}}[handle][kind],
        nvmlDeviceGetPowerUsage=refuses,
        nvmlDeviceGetEnforcedPowerLimit=lambda handle: 700_000,
        nvmlDeviceGetPerformanceState=lambda handle: 0,
        nvmlDeviceGetTemperature=lambda handle, of: 41,
    )
    there = {"pynvml": made, "numba.cuda": SimpleNamespace(get_current_device=lambda: SimpleNamespace(uuid="GPU-0"))}
    monkeypatch.setattr(cuda_device, "is_simulated", lambda: False)
    monkeypatch.setattr(cuda_device, "import_module", there.__getitem__)
    return made


def test_a_row_has_the_reported_state_of_the_device_and_null_for_the_rest(nvml: SimpleNamespace) -> None:
    values = {"sm_clock_mhz": 1980.0, "memory_clock_mhz": 2619.0, "power_w": None, "power_limit_w": 700.0}
    assert cuda_device.read_device_state() == values | {"performance_state": 0.0, "temperature_c": 41.0}


def test_where_the_library_cannot_begin_all_is_null(nvml: SimpleNamespace) -> None:
    nvml.nvmlInit = nvml.nvmlDeviceGetPowerUsage
    assert set(cuda_device.read_device_state().values()) == {None}
