"""Runs on a device: what rows state, that timed steps copy no more than they must, and what becomes of its failures."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.results import parquet_rows
from springbench.solvers.cuda import cuda_device, cuda_target, device_solver
from springbench.solvers.iteration import device_interface as where
from springbench.solvers.model.step_problem import StepProblem
from typer.testing import CliRunner, Result

from tests.scene_builders import CLOTH_SCENE_YAML

SWEEP = """
scenes: [cloth.yaml]
sizes: [3]
solvers: [{name: vbd, device: cuda, spectral_radius: 0}, {name: vbd, spectral_radius: 0}]
options: {max_iterations: 40, rtol: 1.0e-2, rounds: 1, frames: 2, threads: 1, pictures: false, convergence_frames: []}
"""


def run_cloth_command(folder: Path) -> tuple[Result, list[list[dict[str, Any]]]]:
    """What the command says, and the rows of each run; in this process."""
    (folder / "cloth.yaml").write_text(CLOTH_SCENE_YAML)
    sweep = folder / "sweep.yaml"
    sweep.write_text(SWEEP)
    result = CliRunner().invoke(app, ["run", str(sweep), "--results", str(folder / "r"), "--in-process"])
    found = [
        parquet_rows.read_rows([RunFiles.for_run(run, folder / "r" / "sweep").rows_path]).to_pylist()
        for run in load_config(sweep).list_runs()
    ]
    return result, found


def test_rows_name_the_device_and_timed_steps_request_no_residual(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests, timed = list[float](), list[tuple[int, int]]()
    residual, replay = device_solver.DeviceSolverState.residual, device_solver.DeviceSolver.replay_iterations

    def count_request(self: Any) -> float:
        requests.append(residual(self))
        return requests[-1]

    def record_replay(self: Any, problem: StepProblem, iterations: int) -> Any:
        before = len(requests)
        found = replay(self, problem, iterations)
        timed.append((iterations, len(requests) - before))
        return found

    monkeypatch.setattr(device_solver.DeviceSolverState, "residual", count_request)
    monkeypatch.setattr(device_solver.DeviceSolver, "replay_iterations", record_replay)
    result, (here, there) = run_cloth_command(tmp_path)
    assert result.exit_code == 0, result.output
    assert {row["device"] for row in here} == {cuda_device.describe_device()["device"]}
    assert {row["device"] for row in there} == {None}
    phases = Counter(row["phase"] for row in here)
    assert phases == {"prepare": 2, "step": 2}
    steps = [row for row in here if row["phase"] == "step"]
    assert all((row["power_w"] is None) == cuda_device.is_simulated() for row in steps)
    assert {row["termination_reason"] for row in steps} == {"converged"}
    assert timed == [(row["num_iterations"], 0) for row in steps]
    assert all(count % device_solver.ITERATIONS_PER_RESIDUAL == 0 for count, _ in timed)
    assert requests
    assert "vbd, device cuda" in " ".join(result.output.split())


class OutOfMemory(Exception):
    """As the driver raises it."""


class DeviceLost(Exception):
    """As the driver raises it."""


for kind in (OutOfMemory, DeviceLost):
    kind.__module__ = "numba.cuda.cudadrv.driver"


@pytest.mark.parametrize(
    ("error", "said", "lost"),
    [
        (OutOfMemory("CUDA_ERROR_OUT_OF_MEMORY"), "the device has no memory left: CUDA_ERROR_OUT_OF_MEMORY", False),
        (DeviceLost("CUDA_ERROR_ILLEGAL_ADDRESS"), "the device failed: CUDA_ERROR_ILLEGAL_ADDRESS", True),
    ],
    ids=["memory", "lost"],
)
def test_a_device_failure_is_a_row_and_the_sweep_continues(
    error: Exception, said: str, lost: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(where, "_DEVICE_FAILURES", [])

    def fails(self: Any, array: Any) -> Any:
        raise error

    monkeypatch.setattr(cuda_target.DeviceStream, "download_array", fails)
    result, (here, there) = run_cloth_command(tmp_path)
    assert result.exit_code == 1
    assert [row["status"] for row in here] == ["failed"]
    assert said in here[0]["reason"]
    assert {row["status"] for row in there} == {"ok"}
    assert where.is_device_lost() is lost
