"""Measure performance targets: the time of the cheapest method for an error, against a baseline.

Both are timed in one process on one core, interleaved. The smallest CPU time of several rounds counts, including
preparation. If a target is `graded`, its errors are computed from the reference solution. The method's error may then
be at most twice the requested one. It may be below a third of it only where longer steps would be unstable.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import inf
from time import thread_time

from springbench.harness.config.performance_targets import TargetCase, TargetPlan
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget
from springbench.harness.experiments.error_control.method_search import (
    MIN_ERROR_FRACTION,
    Trial,
    compute_predictability_horizon,
    search_cheapest_method,
)
from springbench.harness.experiments.error_control.target_baseline import TargetBaseline, find_baseline
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.solvers.model.step_problem import NotPositiveDefinite, Unsupported

MIN_ROUNDS, MAX_ROUNDS, MIN_TOTAL_SECONDS = 3, 15, 0.5
"""Smallest and largest number of rounds; rounds above the minimum end at this total CPU time of the method [s]."""
MAX_TARGET_ERROR_RATIO = 2.0
"""Largest accepted ratio of the error to the requested one."""


@dataclass(frozen=True, slots=True)
class TargetResult:
    """Measured result of a performance target.

    Attributes:
        target: the performance target.
        size: size of the mesh.
        vertices: number of vertices.
        method: name of the cheapest method.
        error_estimated: its estimated error.
        seconds: its CPU time [s].
        baseline: name of the baseline.
        baseline_error: error of the baseline.
        baseline_seconds: CPU time of the baseline [s].
        is_lower_bound: whether the baseline would take longer than baseline_seconds.
        error: error of the method against the reference solution; None where the target is not graded.
        note: why the method is much more accurate than requested; empty otherwise.
        reason: why there is no result; empty if there is one.
    """

    target: TargetCase
    size: int
    vertices: int = 0
    method: str = ""
    error_estimated: float = inf
    seconds: float = inf
    baseline: str = ""
    baseline_error: float = inf
    baseline_seconds: float = inf
    is_lower_bound: bool = False
    error: float | None = None
    note: str = ""
    reason: str = ""

    @property
    def time_ratio(self) -> float:
        """CPU time of the method divided by that of the baseline.

        It is an upper bound if `is_lower_bound`.
        """
        return self.seconds / self.baseline_seconds

    @property
    def is_error_accepted(self) -> bool:
        """Whether the error against the reference solution, if known, is close to the requested one."""
        if self.error is None:
            return True
        return self.error <= MAX_TARGET_ERROR_RATIO * self.target.error and (
            self.error >= MIN_ERROR_FRACTION * self.target.error or bool(self.note)
        )

    @property
    def is_met(self) -> bool:
        """Whether the error is as requested and the time ratio at most the target ratio."""
        return not self.reason and self.is_error_accepted and self.time_ratio <= self.target.target.wanted


def measure_targets(
    targets: TargetPlan, reference_store: ReferenceStore, print_message: Callable[[str], None]
) -> Iterator[TargetResult]:
    """Measure the targets one after the other; a failure is reported as `reason`.

    Args:
        targets: the performance targets.
        reference_store: store of the reference solutions.
        print_message: prints a remark.
    """
    for one in targets.goals:
        print_message(f"{one.scene} {one.size or ''} to {one.error:g} after {one.target.horizon:g} s:")
        asked = None
        try:
            asked = ErrorTarget.from_scene(targets.scenes[one.scene], one.size, one.target.horizon)
            yield _measure_target(one, asked, reference_store, print_message)
        except (RunFailed, Unsupported, NotPositiveDefinite) as error:
            yield TargetResult(one, asked.size if asked else one.size or 0, reason=str(error))


def _measure_target(
    performance_target: TargetCase,
    error_target: ErrorTarget,
    reference_store: ReferenceStore,
    print_message: Callable[[str], None],
) -> TargetResult:
    seen = compute_predictability_horizon(error_target, performance_target.error, print_message)
    truth = (
        reference_store.load_trajectory(
            error_target.scene, error_target.size, [error_target.t_end], error=performance_target.error
        )
        if performance_target.target.graded
        else None
    )
    answer = search_cheapest_method(error_target, performance_target.error, seen, print_message)
    best, free = answer.best_trial, error_target.build_scene(error_target.frame_seconds, "own").system.free_vertices
    end = best.trajectory.positions[-1]
    other = find_baseline(
        performance_target,
        error_target,
        answer,
        lambda p: truth.measure_error(-1, p) if truth else answer.compute_error(p, free),
        print_message,
    )
    ours, its = _time_interleaved(best, other)
    return TargetResult(
        *(performance_target, error_target.size, len(end), str(best.method), best.error_estimated, ours),
        *(other.name, other.error, its, other.is_lower_bound),
        error=truth.measure_error(-1, end) if truth else None,
        note=answer.note,
    )


def _time_interleaved(trial: Trial, baseline: TargetBaseline) -> tuple[float, float]:
    """Return the smallest CPU seconds of the method and of the baseline, timed interleaved."""
    ours, its = list[float](), [baseline.seconds]
    while len(ours) < MIN_ROUNDS or (sum(ours) < MIN_TOTAL_SECONDS and len(ours) < MAX_ROUNDS):
        ours.append(_measure_cpu_seconds(trial.rerun_trial))
        its += [baseline.rerun_timed()] if baseline.rerun_timed else []
    return min(ours), min(its)


def _measure_cpu_seconds(call: Callable[[], object]) -> float:
    began = thread_time()
    call()
    return thread_time() - began
