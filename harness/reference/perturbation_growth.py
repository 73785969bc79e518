"""Growth of a perturbation of the start, which estimates the predictability horizon for all commands.

Every free coordinate of the start is perturbed by `START_PERTURBATION` of the mesh size, with random sign. Both motions
are integrated with the same steps: by a symplectic composition of order 6 (Blanes and Moan 2002) where it supports the
scene, otherwise by Dormand and Prince's method of order 8. Where the difference has grown to `_LINEAR_LIMIT` times its
initial size, it is rescaled to that size (Benettin et al. 1980), so that it grows as an infinitesimal one does. Once a
perturbation of 1e-12 of the size would have grown to the displacement itself, the motion is no longer predictable.

The samples depend on the end time alone, not on the scene's step size, so that every command obtains the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

import numpy as np
from numpy.typing import NDArray
from springbench.harness.reference.equations_of_motion import OdeField, OdeState, build_ode_scene
from springbench.harness.reference.reference_trajectory import CHECK_PERTURBATION as ROUND_OFF
from springbench.harness.reference.reference_trajectory import (
    REFERENCE_MARGIN,
    ReferenceTrajectory,
    UnpredictableMotion,
)
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import MotionState, prepare, simulate_scene
from springbench.solvers.methods.time_stepping.explicit_integrators import BlanesMoan6
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import StopRule, Unsupported

START_PERTURBATION = 1e-9
"""Initial perturbation relative to the mesh size: a thousand times the round-off of a thousand steps."""
MIN_RELATIVE_ERROR = 1e-11
"""Minimum relative error that can be requested: the round-off of a thousand steps is close to it."""
AT_REST_REASON = "nothing moves up to the horizon, and errors are relative to the displacement"
_SAMPLE_SECONDS, _MIN_SAMPLES = 1 / 30, 30
"""Maximum interval between two samples [s], and minimum number of samples."""
_LINEAR_LIMIT = 1e3
"""Growth factor from which on a difference is rescaled; it is then a millionth of the size."""
_HORIZON_SAFETY = 0.5
"""Fraction of the allowed growth at a recommended horizon, since the samples of that horizon differ."""
_NUM_REFINEMENTS, _RTOL = 2, 1e-9
"""Accuracy of the two methods, at which growth up to 1e-2 equals that of the reference.

Smaller steps do not change it."""

AdvanceFunction = Callable[[int, OdeState], OdeState]
"""Maps an interval index and the states of both motions at its start, concatenated, to those at its end."""


@dataclass(frozen=True, slots=True, eq=False)
class PerturbationGrowth:
    """Growth of a perturbation over a motion.

    Attributes:
        times: sample times (k,) [s].
        displacement: displacement from the start (k,) [m], Frobenius norm over the free vertices.
        growth_factor: size (k,) of a perturbation that was 1e-12 of the mesh size at the start, relative to the
            displacement, at most 1.
        scale: root mean square displacement of a free coordinate at the end [m].
    """

    times: NDArray[np.float64]
    displacement: NDArray[np.float64]
    growth_factor: NDArray[np.float64]
    scale: float

    @classmethod
    def from_reference(cls, reference: ReferenceTrajectory) -> PerturbationGrowth:
        """Return the uncertainty of a reference as growth, for scenes without equations of motion."""
        coordinates = 3 * max(1, len(reference.free_vertices))
        scale = float(reference.displacement[-1]) / coordinates**0.5
        return cls(reference.times, reference.displacement, reference.disagreement, scale)

    @property
    def min_error(self) -> float:
        """The smallest relative error that can be reached or measured at the end, including round-off."""
        return _min_error(float(self.growth_factor[-1]))

    def interpolate_growth(self, times: Sequence[float]) -> NDArray[np.float64]:
        """Return the growth (k,) at other times [s] by interpolation."""
        return np.interp(times, self.times, self.growth_factor)

    def compute_longest_horizon(self, error: float) -> float:
        """Return the longest horizon [s] at which a relative error can reliably be measured.

        The error can also be reached there. The result is rounded down to three digits, and 0 where there is none.
        """
        fine = self.times[self.growth_factor <= _HORIZON_SAFETY * REFERENCE_MARGIN * error]
        return _round_digits(floor, float(fine[-1]), 3) if len(fine) and error >= MIN_RELATIVE_ERROR else 0.0

    def require_predictable(self, error: float, times: Sequence[float] = ()) -> None:
        """Require that a relative error can be measured at some times.

        Args:
            error: relative error.
            times: times [s]; the end if omitted.

        Raises:
            UnpredictableMotion: the perturbation has grown too large at one of the times.
        """
        times = times or [float(self.times[-1])]
        for t, grown in zip(times, self.interpolate_growth(times), strict=True):
            if _min_error(grown) > error:
                raise UnpredictableMotion(
                    f"after {t:g} s a perturbation of 1e-12 of the size has grown to {grown:.1e} of the displacement: "
                    f"an error of {error:g} cannot be reached or measured there; "
                    f"{self._suggest_alternative(error, _min_error(grown))}"
                )

    def _suggest_alternative(self, error: float, least: float) -> str:
        longest = self.compute_longest_horizon(error)
        possible = [f"an --error of {_round_digits(ceil, least, 2):g} or more"] if least < 1.0 else []
        possible += [f"a --t-end of {longest:g} s or less"] if longest else []
        return f"use {', or '.join(possible) or 'another scene'}"


def estimate_growth(spec: SceneSpec, size: int, t_end: float) -> PerturbationGrowth:
    """Estimate the growth of a perturbation of a scene's motion up to an end time.

    Args:
        spec: specification of the scene.
        size: size of the scene.
        t_end: end time [s].

    Raises:
        UnpredictableMotion: nothing moves, or the motion is not finite.
        NotIntegrable: the scene has no equation of motion.
    """
    samples = max(_MIN_SAMPLES, ceil(t_end / _SAMPLE_SECONDS * (1.0 - 1e-9)))
    scene, begun, advance = _build_motion(spec, size, t_end / samples)
    half, length = len(begun) // 2, scene.mesh.bounding_box_diagonal or 1.0
    # The round-off of coordinates far from the origin is larger than 1e-12 of the size.
    unit = max(ROUND_OFF * length, float(np.spacing(np.abs(begun[:half]).max(initial=0.0))))
    nudge = np.zeros_like(begun)
    nudge[:half] = np.random.default_rng(0).choice([-1.0, 1.0], half) * unit * (START_PERTURBATION / ROUND_OFF)
    one, two, first, factor = begun, begun + nudge, float(np.linalg.norm(nudge)), ROUND_OFF / START_PERTURBATION
    moved, grown = np.zeros(samples), np.ones(samples)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(samples):
            one, two = np.split(advance(k, np.concatenate((one, two))), 2)
            moved[k], apart = (float(np.linalg.norm((y - one)[:half])) for y in (begun, two))
            if not np.isfinite(moved[k] + apart):
                raise UnpredictableMotion(f"the motion is not finite {(k + 1) * t_end / samples:.3g} s after its start")
            grown[k] = min(1.0, factor * apart / moved[k]) if moved[k] else 1.0
            if grown[k] >= 1.0 and moved[k] > 1e3 * unit * max(1, half) ** 0.5:
                break
            if apart > _LINEAR_LIMIT * first:
                two, factor = one + (two - one) * (first / apart), factor * apart / first
    if not moved.max() > unit * max(1, half) ** 0.5:
        raise UnpredictableMotion(AT_REST_REASON)
    times: NDArray[np.float64] = np.linspace(0.0, t_end, samples + 1)[1:]
    return PerturbationGrowth(times, moved, grown, float(moved[-1]) / max(1, half) ** 0.5)


def _build_motion(spec: SceneSpec, size: int, interval: float) -> tuple[Scene, OdeState, AdvanceFunction]:
    """Build the scene, its start, and the function that advances both motions."""
    scene = build_exact_scene(spec.with_time_step(interval), size, "substepping", show_warnings=False)
    if not scene.varying_forces and not scene.pin_motions:
        try:
            ready = prepare(scene, BlanesMoan6(refinement_factor=_NUM_REFINEMENTS))
        except Unsupported:
            pass
        else:
            field = OdeField(scene)

            def compose_steps(k: int, both: OdeState) -> OdeState:
                ends = list[OdeState]()
                for y in np.split(both, 2):
                    p, v = (part.copy() for part in field.unpack_state(k * interval, y))
                    begun = MotionState(Motion(p, v), None, k)
                    (done,) = simulate_scene(
                        scene, ready, StopRule(1), initial_guess="previous", frames=k + 1, initial_state=begun
                    )
                    ends += [part[scene.system.free_vertices].ravel() for part in done.state.motion]
                return np.concatenate(ends)

            return scene, field.initial_state, compose_steps
    from scipy.integrate import solve_ivp  # takes a third of a second to import

    scene = build_ode_scene(spec, size)
    field = OdeField(scene)
    atol = _RTOL * (scene.mesh.bounding_box_diagonal or 1.0)

    def evaluate_halves(t: float, y: OdeState) -> OdeState:
        return np.concatenate([field(t, part) for part in np.split(y, 2)])

    def integrate_interval(k: int, y: OdeState) -> OdeState:
        solved = solve_ivp(evaluate_halves, (k * interval, (k + 1) * interval), y, "DOP853", rtol=_RTOL, atol=atol)
        return np.array(solved.y[:, -1]) if solved.success else np.full_like(y, np.nan)

    return scene, field.initial_state, integrate_interval


def _min_error(grown: float) -> float:
    return max(float(grown) / REFERENCE_MARGIN, MIN_RELATIVE_ERROR)


def _round_digits(to_whole: Callable[[float], int], x: float, digits: int) -> float:
    """Round to a number of significant digits."""
    shift = digits - 1 - floor(log10(x))
    return round(to_whole(round(x * 10.0**shift, 6)) * 10.0**-shift, max(shift, 0))
