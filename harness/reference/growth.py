"""How fast a perturbation of the start grows: the estimate of the predictable horizon that all commands use.

Every free coordinate of the start is perturbed by `PERTURBATION` of the mesh's size, to either side, and both motions
are integrated by the same steps: by a symplectic composition of order 6 (Blanes and Moan 2002) where it supports the
scene, else by Dormand and Prince's method of order 8. Where their difference has grown to `_LINEAR` times its start, it
is rescaled to it (Benettin et al. 1980), so that it grows as an infinitesimal one does. Once 1e-12 of the size would
have grown to the displacement itself, nothing is known of the motion any more.

The samples depend on the horizon alone, not on the scene's time step, so that every command finds the same.
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
"""Of the size: a thousand times the round-off of a thousand steps."""
LEAST = 1e-11
"""No relative error is asked below it: the sum of a thousand steps' round-off comes near."""
AT_REST = "nothing moves up to the horizon, and errors are relative to what does"
_INTERVAL, _SAMPLES = 1 / 30, 30
"""Seconds between two samples at most, and samples at least."""
_LINEAR = 1e3
"""Times its start, from which a difference is rescaled: it is a millionth of the size then."""
_SURE = 0.5
"""Of the growth allowed, that at a horizon that is recommended: its own samples lie elsewhere."""
_REFINE, _RTOL = 2, 1e-9
"""Of the two methods: growth up to 1e-2 is then that of the reference, which closer steps do not change."""

Advance = Callable[[int, State], State]
"""The states of both motions, one after the other, at the end of the interval of an index, by those at its start."""


@dataclass(frozen=True, slots=True, eq=False)
class Growth:
    """times (k,) [s]; moved (k,) [m]: the displacement from the start, Frobenius norm over the free vertices; grown
    (k,): what a perturbation of 1e-12 of the size at the start has become, relative to that, at most 1; scale: the
    displacement of a free coordinate at the end, root mean square [m]."""

    times: NDArray[np.float64]
    moved: NDArray[np.float64]
    grown: NDArray[np.float64]
    scale: float

    @property
    def least(self) -> float:
        """The least relative error that can be reached or measured at the end, round-off included."""
        return _least(float(self.grown[-1]))

    def at(self, times: Sequence[float]) -> NDArray[np.float64]:
        """The growth (k,) at other times [s], by interpolation."""
        return np.interp(times, self.times, self.grown)

    def longest(self, error: float) -> float:
        """The longest horizon [s] at which a relative error can surely be reached and measured, rounded down to three
        digits; 0 for none."""
        fine = self.times[self.grown <= _SURE * MARGIN * error]
        return _rounded(floor, float(fine[-1]), 3) if len(fine) and error >= LEAST else 0.0

    def require(self, error: float, times: Sequence[float] = ()) -> None:
        """Raise Unpredictable where a relative error cannot be measured at some times [s], the end if left out."""
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
    """Of the motion of a scene up to a horizon [s].

    Raises Unpredictable where nothing moves and where the motion is not finite, Unintegrable.
    """
    samples = max(_SAMPLES, ceil(horizon / _INTERVAL * (1.0 - 1e-9)))
    scene, begun, advance = _motion(spec, size, horizon / samples)
    half, length = len(begun) // 2, scene.mesh.size or 1.0
    # Coordinates far from the origin are rounded by more than 1e-12 of the size.
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
    """The scene, its start, and what advances both motions."""
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
    """Rounded to so many digits."""
    shift = digits - 1 - floor(log10(x))
    return round(to_whole(round(x * 10.0**shift, 6)) * 10.0**-shift, max(shift, 0))
