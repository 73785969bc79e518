"""Record a solve: the mesh at each scored iterate, and the distance from the minimum."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from harness.base import machine
from harness.config.accuracy import CurveSpec
from harness.experiments.accuracy.curves import GradedCurve
from harness.experiments.accuracy.scales import round_off
from harness.record.base import Frame, RecordingInfo
from harness.record.rerun import RerunRecorder
from harness.record.shading import strain_range
from harness.reference.frozen import Frozen
from harness.reference.minimiser import KnownMinima
from harness.scenes.bind import Scene


class FrozenStep(Protocol):
    """Step snapshot with its known minima."""

    @property
    def moment(self) -> str:
        """Name of the snapshot."""
        ...

    @property
    def frozen(self) -> Frozen:
        """The problem of the step."""
        ...

    @property
    def reference(self) -> KnownMinima:
        """The known minima of the step."""
        ...


def record(
    spec: CurveSpec, graded: FrozenStep, scene: Scene, first_guess: str, curve: GradedCurve, folder: Path
) -> Path:
    """Write the recording of a curve under `folder`/recordings and return its path.

    Args:
        spec: the curves of the solver.
        graded: the step snapshot.
        scene: the scene.
        first_guess: name of the initial guess.
        curve: the scored iterates.
        folder: folder of the results.

    Raises:
        RunFailed: the recording is incomplete.
    """
    path = folder / "recordings" / f"{spec.label()}-{first_guess}.rrd"
    problem, here = graded.frozen.problem, machine.describe()
    finite = [p for p in curve.positions if np.isfinite(p).all()]
    info = RecordingInfo(
        title=f"{spec.case.title}, {graded.moment}: {spec.solver.name} from the {first_guess} positions",
        run_id=f"{spec.unit_id(here.id)}-{first_guess}",
        mesh=scene.mesh,
        springs=scene.springs.edges,
        rest_lengths=scene.springs.rest_length,
        pinned=problem.system.pins.vertices,
        time_step=problem.system.time_step,
        strain_range=strain_range(finite[-1:], scene.springs.edges, scene.springs.rest_length),
        properties={
            "scene": spec.case.scene_name,
            "size": spec.case.size,
            "solver": spec.solver.name,
            "moment": graded.moment,
            "step": graded.frozen.frame,
            "problem": graded.frozen.digest,
            "first_guess": first_guess,
            "status": curve.status,
            "cpu": here.cpu,
            "commit": machine.commit(),
        },
        iterates=True,
    )
    recorder = RerunRecorder(path, info)
    try:
        for k, p in enumerate(curve.positions):
            if np.isfinite(p).all():
                terms = problem.terms(p)
                number, stationarity = curve.numbers[k], curve.stationarity[k]
                recorder.frame(Frame(number, problem.start.time, p, terms, stationarity, number))
        best = graded.reference.minima[:1]
        recorder.solve(curve.numbers, _curves(curve, graded, best[0].g if best else float("nan")))
        return recorder.close({})
    finally:
        recorder.abandon()


def _curves(curve: GradedCurve, graded: FrozenStep, lowest: float) -> dict[str, list[float]]:
    problem = graded.frozen.problem
    gap = (np.array(curve.g) - lowest) / max(problem.value(problem.current) - lowest, round_off(problem))
    return {"energy gap": gap.tolist(), "stationarity": curve.stationarity}
