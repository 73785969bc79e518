"""Compare with third-party integrators on the equations of motion, at the same error.

Forces are compiled, as for the methods of this package. One SciPy integrator runs with NumPy forces too, which is
typical of a first implementation. The tolerance of each integrator is changed until its error matches the target. The
errors are estimated from the same reference trial.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from math import inf
from time import perf_counter, thread_time

from springbench.harness.errors import RunFailed
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget
from springbench.harness.experiments.error_control.method_search import ERROR_AIM
from springbench.harness.experiments.error_control.method_trials import SearchResult
from springbench.harness.experiments.error_control.third_party_integrators import (
    THIRD_PARTY_INTEGRATORS,
    InitialValueProblem,
)
from springbench.harness.reference.equations_of_motion import OdeField, OdeState
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.adaptive_stepping import TimeBudgetExceeded, build_budget_error

MAX_INTEGRATION_SECONDS = 5.0
"""CPU time limit of an integrator for one motion [s]."""
_MAX_TOLERANCES, _MIN_ERROR_FRACTION = 5, 0.2
"""Largest number of tolerances per integrator; fraction of the target error that ends the adjustment."""


@dataclass(frozen=True, slots=True)
class ThirdPartyResult:
    """Result of a third-party integrator.

    Attributes:
        name: name of the integrator.
        error_estimated: estimated relative error.
        wall_seconds: wall time [s].
        cpu_time_ratio: CPU time divided by that of the search result, both including preparation.
        reason: why there is no result; empty if there is one.
        cpu_seconds: CPU time [s].
    """

    name: str
    error_estimated: float
    wall_seconds: float
    cpu_time_ratio: float
    reason: str = ""
    cpu_seconds: float = inf


def compare_third_party(
    error_target: ErrorTarget, error: float, search_result: SearchResult, names: Iterable[str] = THIRD_PARTY_INTEGRATORS
) -> Iterator[ThirdPartyResult]:
    """Measure third-party integrators one after the other; a failure is reported as `reason`.

    Args:
        error_target: the scene and its end time.
        error: relative error to reach.
        search_result: result to compare with.
        names: integrators in THIRD_PARTY_INTEGRATORS.

    Raises:
        NotIntegrable: the scene has no equations of motion.
    """
    scene = error_target.build_scene(error_target.frame_seconds, "newmark")
    fields = {compiled: OdeField(scene, compiled=compiled) for compiled in (True, False)}
    fields[True].evaluate_fingerprint()  # compiles
    began = thread_time()
    search_result.best_trial.rerun_trial()
    comparison = _ThirdPartyComparison(error_target, error, search_result, scene, fields, thread_time() - began)
    yield from map(comparison.measure_integrator, names)


@dataclass(frozen=True, eq=False)
class _ThirdPartyComparison:
    """Comparison of one search result; `own_cpu_seconds` is the CPU time of its best trial."""

    error_target: ErrorTarget
    error: float
    search_result: SearchResult
    scene: Scene
    vector_fields: dict[bool, OdeField]
    own_cpu_seconds: float

    def measure_integrator(self, name: str) -> ThirdPartyResult:
        """Measure one integrator.

        Its tolerance is adjusted until the error is below the target, but not far below. Where no tolerance does both,
        the cheapest one that meets the error counts.
        """
        order, tolerance = THIRD_PARTY_INTEGRATORS[name].order, 0.2 * self.search_result.step_atol
        if missing := THIRD_PARTY_INTEGRATORS[name].missing_reason:
            return ThirdPartyResult(name, inf, inf, inf, missing)
        found = ThirdPartyResult(name, inf, inf, inf, "its error does not reach the target")
        for _ in range(_MAX_TOLERANCES):
            one = self._integrate_at_tolerance(name, tolerance)
            if one.reason:
                return one if found.reason else found
            if one.error_estimated <= self.error and one.cpu_time_ratio < found.cpu_time_ratio:
                found = one
            if found.reason == "" and one.error_estimated >= _MIN_ERROR_FRACTION * self.error:
                return found
            aim = ERROR_AIM * self.error / max(one.error_estimated, 1e-15)
            tolerance *= min(1e3, max(1e-3, aim ** ((order + 1.0) / order)))
        return found

    def _integrate_at_tolerance(self, name: str, step_atol: float) -> ThirdPartyResult:
        """Integrate at one tolerance [m]."""
        library, free, size = (
            THIRD_PARTY_INTEGRATORS[name],
            self.scene.system.free_vertices,
            self.scene.mesh.bounding_box_diagonal or 1.0,
        )
        field = self.vector_fields[library.uses_compiled_forces]
        began, cpu = perf_counter(), thread_time()
        limited = _limit_cpu_time(field, cpu + MAX_INTEGRATION_SECONDS)
        motion = InitialValueProblem(
            limited, field.initial_state, self.scene, self.error_target.t_end, max(step_atol / size, 1e-13), step_atol
        )
        try:
            end = library.integrate_to_end(motion)
        except TimeBudgetExceeded:
            return ThirdPartyResult(name, inf, inf, inf, f"takes more than {MAX_INTEGRATION_SECONDS:g} s")
        except RunFailed as failed:
            return ThirdPartyResult(name, inf, inf, inf, str(failed))
        seconds, processor = perf_counter() - began, thread_time() - cpu
        p, _ = field.unpack_state(self.error_target.t_end, end)
        return ThirdPartyResult(
            name,
            self.search_result.compute_error(p, free),
            seconds,
            processor / self.own_cpu_seconds,
            cpu_seconds=processor,
        )


def _limit_cpu_time(vector_field: OdeField, deadline: float) -> Callable[[float, OdeState], OdeState]:
    """Return the vector field with a deadline on the CPU clock [s].

    After the deadline it raises TimeBudgetExceeded.
    """

    def rate(t: float, y: OdeState) -> OdeState:
        if thread_time() > deadline:
            raise build_budget_error(MAX_INTEGRATION_SECONDS, t)
        return vector_field(t, y)

    return rate
