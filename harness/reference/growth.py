"""Growth of a perturbation of the start: the estimate of the predictability horizon for all commands.

Every free coordinate of the start is perturbed by `PERTURBATION` of the mesh size, with random sign. Both motions
are integrated with the same steps: by a symplectic composition of order 6 (Blanes and Moan 2002) where it supports the
scene, otherwise by Dormand and Prince's method of order 8. Where the difference has grown to `_LINEAR` times its
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
from scipy.integrate import solve_ivp

from harness.reference.frozen import bind
from harness.reference.motion import Field, State, moving
from harness.reference.trajectory import MARGIN, Unpredictable
from harness.reference.trajectory import PERTURBATION as ROUND_OFF
from harness.scenes.bind import Scene
from harness.scenes.spec import SceneSpec
from harness.simulation import step as steps
from harness.simulation.step import prepare, simulate
from solvers.integrators import Motion
from solvers.methods.explicit import BlanesMoan6
from solvers.problem import StopRule, Unsupported

PERTURBATION = 1e-9
"""Initial perturbation relative to the mesh size: a thousand times the round-off of a thousand steps."""
LEAST = 1e-11
"""Minimum relative error that can be requested: the round-off of a thousand steps is close to it."""
AT_REST = "nothing moves up to the horizon, and errors are relative to what does"
_INTERVAL, _SAMPLES = 1 / 30, 30
"""Maximum interval between two samples [s], and minimum number of samples."""
_LINEAR = 1e3
"""Growth factor from which on a difference is rescaled; it is then a millionth of the size."""
_SURE = 0.5
"""Fraction of the allowed growth at a recommended horizon, since the samples of that horizon differ."""
_REFINE, _RTOL = 2, 1e-9
"""Accuracy of the two methods: growth up to 1e-2 then equals that of the reference, and smaller steps do not change
it."""

Advance = Callable[[int, State], State]
"""Maps an interval index and the states of both motions at its start, concatenated, to those at its end."""


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """Growth of a perturbation over a motion.

    Attributes:
      times: sample times (k,) [s].
      moved: displacement from the start (k,) [m], Frobenius norm over the free vertices.
      grown: size (k,) of a perturbation that was 1e-12 of the mesh size at the start, relative to the
        displacement, at most 1.
      scale: root mean square displacement of a free coordinate at the end [m].
    """

    times: NDArray[np.float64]
    moved: NDArray[np.float64]
    grown: NDArray[np.float64]
    scale: float

    @property
    def least(self) -> float:
        """The smallest relative error that can be reached or measured at the end, including round-off."""
        return _least(float(self.grown[-1]))

    def at(self, times: Sequence[float]) -> NDArray[np.float64]:
        """Return the growth (k,) at other times [s] by interpolation."""
        return np.interp(times, self.times, self.grown)

    def longest(self, error: float) -> float:
        """Return the longest horizon [s] at which a relative error can reliably be measured.

        The error can also be reached there. The result is rounded down to three digits, and 0 where there is none.
        """
        fine = self.times[self.grown <= _SURE * MARGIN * error]
        return _rounded(floor, float(fine[-1]), 3) if len(fine) and error >= LEAST else 0.0

    def require(self, error: float, times: Sequence[float] = ()) -> None:
        """Require that a relative error can be measured at some times.

        Args:
          error: relative error.
          times: times [s]; the end if omitted.

        Raises:
          Unpredictable: the perturbation has grown too large at one of the times.
        """
        times = times or [float(self.times[-1])]
        for t, grown in zip(times, self.at(times), strict=True):
            if _least(grown) > error:
                raise Unpredictable(
                    f"after {t:g} s a perturbation of 1e-12 of the size has grown to {grown:.1e} of the displacement: "
                    f"an error of {error:g} cannot be reached or measured there; {self._instead(error, _least(grown))}"
                )

    def _instead(self, error: float, least: float) -> str:
        longest = self.longest(error)
        possible = [f"an --error of {_rounded(ceil, least, 2):g} or more"] if least < 1.0 else []
        possible += [f"a --horizon of {longest:g} s or less"] if longest else []
        return f"ask for {', or '.join(possible) or 'another scene'}"


def growth(spec: SceneSpec, size: int, horizon: float) -> Growth:
    """Estimate the growth of a perturbation of a scene's motion up to an end time.

    Args:
      spec: specification of the scene.
      size: size of the scene.
      horizon: end time [s].

    Raises:
      Unpredictable: nothing moves, or the motion is not finite.
      Unintegrable: the scene has no equation of motion.
    """
    samples = max(_SAMPLES, ceil(horizon / _INTERVAL * (1.0 - 1e-9)))
    scene, begun, advance = _motion(spec, size, horizon / samples)
    half, length = len(begun) // 2, scene.mesh.size or 1.0
    # The round-off of coordinates far from the origin is larger than 1e-12 of the size.
    unit = max(ROUND_OFF * length, float(np.spacing(np.abs(begun[:half]).max(initial=0.0))))
    nudge = np.zeros_like(begun)
    nudge[:half] = np.random.default_rng(0).choice([-1.0, 1.0], half) * unit * (PERTURBATION / ROUND_OFF)
    one, two, first, factor = begun, begun + nudge, float(np.linalg.norm(nudge)), ROUND_OFF / PERTURBATION
    moved, grown = np.zeros(samples), np.ones(samples)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(samples):
            one, two = np.split(advance(k, np.concatenate((one, two))), 2)
            moved[k], apart = (float(np.linalg.norm((y - one)[:half])) for y in (begun, two))
            if not np.isfinite(moved[k] + apart):
                raise Unpredictable(f"the motion is not finite {(k + 1) * horizon / samples:.3g} s after its start")
            grown[k] = min(1.0, factor * apart / moved[k]) if moved[k] else 1.0
            if grown[k] >= 1.0 and moved[k] > 1e3 * unit * max(1, half) ** 0.5:
                break
            if apart > _LINEAR * first:
                two, factor = one + (two - one) * (first / apart), factor * apart / first
    if not moved.max() > unit * max(1, half) ** 0.5:
        raise Unpredictable(AT_REST)
    times: NDArray[np.float64] = np.linspace(0.0, horizon, samples + 1)[1:]
    return Growth(times, moved, grown, float(moved[-1]) / max(1, half) ** 0.5)


def _motion(spec: SceneSpec, size: int, interval: float) -> tuple[Scene, State, Advance]:
    """Build the scene, its start, and the function that advances both motions."""
    scene = bind(spec.stepped(interval), size, "own", warns=False)
    if not scene.forces and not scene.moving:
        try:
            ready = prepare(scene, BlanesMoan6(refine=_REFINE))
        except Unsupported:
            pass
        else:
            field = Field(scene)

            def composed(k: int, both: State) -> State:
                ends = list[State]()
                for y in np.split(both, 2):
                    p, v = (part.copy() for part in field.motion(k * interval, y))
                    begun = steps.State(Motion(p, v), None, k)
                    (done,) = simulate(scene, ready, StopRule(1), first_guess="current", frames=k + 1, state=begun)
                    ends += [part[scene.system.free].ravel() for part in done.state.now]
                return np.concatenate(ends)

            return scene, field.start, composed
    scene = moving(spec, size)
    field = Field(scene)
    atol = _RTOL * (scene.mesh.size or 1.0)

    def both(t: float, y: State) -> State:
        return np.concatenate([field(t, part) for part in np.split(y, 2)])

    def integrated(k: int, y: State) -> State:
        solved = solve_ivp(both, (k * interval, (k + 1) * interval), y, "DOP853", rtol=_RTOL, atol=atol)
        return np.array(solved.y[:, -1]) if solved.success else np.full_like(y, np.nan)

    return scene, field.start, integrated


def _least(grown: float) -> float:
    return max(float(grown) / MARGIN, LEAST)


def _rounded(to_whole: Callable[[float], int], x: float, digits: int) -> float:
    """Round to a number of significant digits."""
    shift = digits - 1 - floor(log10(x))
    return round(to_whole(round(x * 10.0**shift, 6)) * 10.0**-shift, max(shift, 0))
