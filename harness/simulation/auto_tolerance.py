"""Automatic tolerance of a step's solve, relative to the local error of the step.

The residual may add little to the local error:

    rate |dp|_M <= |residual|_Q,    |dp|_M + T rate |dp|_M <= PART (|e_p|_M + T |e_v|_M),    T the simulated time

PART is LOCAL_ERROR_SHARE. An error dp of the stage changes the motion by dp now and by T rate dp at its end, as do the
local errors e_p of the positions and e_v of the velocities. Both are estimated for the previous step by backward
differences of the velocity at the ends of steps, for an integrator of order q. An embedded method also provides an
estimate, though of the lower order. The smaller one is used:

    e_p = h |D^q v|_M / (q + 1)!,    e_v = |D^(q+1) v|_M / (q + 1)!

The residuals themselves enter the differences with a factor of at most PART 2^(q+1)/(q + 1)! <= 0.2 per step. The noise
of one step therefore decays in the following ones. The first steps have no history.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import factorial

import numpy as np
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, StopRule, Unsupported

LOCAL_ERROR_SHARE = 0.1
"""Share of the local error that residuals may add to it."""
FIRST_STEP_RTOL = 1e-10
"""Relative tolerance of the steps without a history, with respect to the residual at their start."""
_TINY = 1e-300
"""Smallest tolerance [J^(1/2)]; a scene at rest is at round-off, which ends its solve at once."""


@dataclass(frozen=True, slots=True)
class AutoTolerance:
    """`rtol: auto` with a maximum number of iterations."""

    max_iterations: int


StopCriterion = StopRule | AutoTolerance


def build_stop_rule(max_iterations: int, rtol: float | str | None) -> StopCriterion:
    """Build the stop rule from a run's options.

    Args:
        max_iterations: maximum number of iterations of a solve.
        rtol: relative tolerance, None for none; any text selects the automatic tolerance.
    """
    return AutoTolerance(max_iterations) if isinstance(rtol, str) else StopRule(max_iterations, rtol)


@dataclass(frozen=True, slots=True)
class ConstantStopRule:
    """One stop rule for all steps."""

    rule: StopRule

    def record_step(self, after: Motion, error: Motion | None) -> None:
        """Ignore the end of a step, which does not change the rule.

        Args:
            after: motion at the end of the step.
            error: embedded error estimate of the step, None without one.
        """


class LocalErrorStopRule:
    """Stop rule from the local errors of the previous steps of one motion.

    `rule` is that of the next step.
    """

    def __init__(self, auto: AutoTolerance, scene: Scene, now: Motion, frames: int) -> None:
        """Start with no history.

        Args:
            auto: limit of the iterations.
            scene: scene that is stepped.
            now: motion at the start.
            frames: number of steps up to the end.

        Raises:
            Unsupported: the step size is not constant.
        """
        if scene.alternate_scene:
            raise Unsupported(
                "rtol: auto requires a constant step size, and the scene alternates two; give a number, such as "
                "rtol: 1e-6"
            )
        system, order = scene.system, scene.integrator.order
        self._iterations, self._span, self._order = auto.max_iterations, frames * system.time_step, order
        self._step, self._rate, self._free = system.time_step, system.velocity_rate, system.free_vertices
        self._mass = system.mass[self._free, None]
        self._past = deque([now.velocity], order + 2)
        self.rule = StopRule(auto.max_iterations, FIRST_STEP_RTOL)

    def record_step(self, after: Motion, error: Motion | None) -> None:
        """Record the end of a step, and set the rule of the next one.

        Args:
            after: motion at the end of the step.
            error: embedded error estimate of the step, (n, 3) [m] and (n, 3) [m/s]; None without one.
        """
        self._past.append(after.velocity)
        if len(self._past) < self._order + 2:
            return
        differences = np.diff(np.array(self._past), self._order, axis=0) / factorial(self._order + 1)
        least = self._error_norm(self._step * differences[-1], differences[1] - differences[0])
        if error is not None:
            least = min(least, self._error_norm(*error))
        within = LOCAL_ERROR_SHARE * least / (1.0 / self._rate + self._span)
        self.rule = StopRule(self._iterations, atol=max(within, _TINY))

    def _error_norm(self, moved: Positions, sped: Positions) -> float:
        """Return the norm [kg^(1/2) m] of e_p [m] and e_v [m/s], (n, 3), combined."""
        return self._mass_norm(moved) + self._span * self._mass_norm(sped)

    def _mass_norm(self, x: Positions) -> float:
        """Return |x|_M over the free vertices."""
        return float(np.sqrt((self._mass * x[self._free] ** 2).sum()))
