"""Record a solve: the mesh at each scored iterate, and the distance from the minimum."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
from springbench.harness.config.accuracy_config import CurveSpec
from springbench.harness.execution import machine_info
from springbench.harness.experiments.accuracy.convergence_curves import ScoredCurve
from springbench.harness.experiments.accuracy.step_scales import compute_energy_roundoff
from springbench.harness.recording.recorder_interface import RecordedFrame, RecordingInfo
from springbench.harness.recording.strain_shading import compute_strain_range
from springbench.harness.reference.certified_minimum import KnownMinima
from springbench.harness.reference.step_snapshot import StepSnapshot
from springbench.harness.scenes.scene_builder import Scene


class EvaluatedStep(Protocol):
    """Step snapshot with its known minima."""

    @property
    def snapshot_name(self) -> str:
        """Name of the snapshot."""
        ...

    @property
    def step_snapshot(self) -> StepSnapshot:
        """The problem of the step."""
        ...

    @property
    def known_minima(self) -> KnownMinima:
        """The known minima of the step."""
        ...


def record_solve(
    spec: CurveSpec, step: EvaluatedStep, scene: Scene, initial_guess: str, curve: ScoredCurve, folder: Path
) -> Path:
    """Write the recording of a curve under `folder`/recordings and return its path.

    Args:
        spec: the curves of the solver.
        step: the step snapshot.
        scene: the scene.
        initial_guess: name of the initial guess.
        curve: the scored iterates.
        folder: folder of the results.

    Raises:
        RunFailed: the recording is incomplete.
    """
    path = folder / "recordings" / f"{spec.build_file_stem()}-{initial_guess}.rrd"
    problem, here = step.step_snapshot.problem, machine_info.describe_machine()
    finite = [p for p in curve.positions if np.isfinite(p).all()]
    info = RecordingInfo(
        title=f"{spec.case.title}, {step.snapshot_name}: {spec.solver.name} from the {initial_guess} positions",
        run_id=f"{spec.compute_unit_id(here.machine_id)}-{initial_guess}",
        mesh=scene.mesh,
        springs=scene.all_springs.edges,
        rest_lengths=scene.all_springs.rest_length,
        pinned_vertices=problem.system.pins.vertices,
        time_step=problem.system.time_step,
        strain_range=compute_strain_range(
            scene.mesh.rest_positions, finite[-1:], scene.all_springs.edges, scene.all_springs.rest_length
        ),
        has_self_contact=scene.has_self_contact,
        properties={
            "scene": spec.case.scene_name,
            "size": spec.case.size,
            "solver": spec.solver.name,
            "snapshot": step.snapshot_name,
            "step": step.step_snapshot.frame,
            "problem_digest": step.step_snapshot.digest,
            "initial_guess": initial_guess,
            "status": curve.status,
            "cpu": here.cpu,
            "commit": machine_info.read_commit(),
        },
        is_solve=True,
    )
    from springbench.harness.recording.rerun_recorder import RerunRecorder

    recorder = RerunRecorder(path, info)
    try:
        for k, p in enumerate(curve.positions):
            if np.isfinite(p).all():
                terms = problem.evaluate_terms(p)
                number, stationarity = curve.iterate_indices[k], curve.stationarity[k]
                recorder.record_frame(RecordedFrame(number, problem.step_start.time, p, terms, stationarity, number))
        best = step.known_minima.minima[:1]
        recorder.record_solve(
            curve.iterate_indices, _build_plot_curves(curve, step, best[0].objective if best else float("nan"))
        )
        return recorder.finish_recording({})
    finally:
        recorder.abandon_recording()


def _build_plot_curves(curve: ScoredCurve, step: EvaluatedStep, lowest_energy: float) -> dict[str, list[float]]:
    problem = step.step_snapshot.problem
    gap = (np.array(curve.g) - lowest_energy) / max(
        problem.value(problem.current_positions) - lowest_energy, compute_energy_roundoff(problem)
    )
    return {"energy gap": gap.tolist(), "stationarity": curve.stationarity}
