"""What grades an iterate: the step's objective and its stationarity, in plain NumPy and float64.

    stationarity(p) = |Q^-1 grad g(p)|_Q / |Q^-1 grad g(p0)|_Q       p0 the current positions

with the Q of local-global iterations over the vertices that are not exactly pinned, so that it means the same for
every solver. Energies that are not projective are no part of that Q.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from solvers.linear.choice import factorise
from solvers.matrices import assemble
from solvers.problem import Positions, ProjectiveEnergy, StepProblem, System


class Oracle:
    """Grades iterates of one step problem, whose pins are exact."""

    def __init__(self, problem: StepProblem) -> None:
        """Raises NotPositiveDefinite."""
        self.problem, system = problem, problem.system
        self._free = system.free
        Q = assemble(system, [e for e in problem.energies if isinstance(e, ProjectiveEnergy)])
        self._factor = factorise(Q[self._free][:, self._free])[0] if len(self._free) else None

    @cached_property
    def yardstick(self) -> float:
        """|Q^-1 grad g|_Q [J^(1/2)] at the current positions."""
        return self._residual(self.problem.current)

    @cached_property
    def g0(self) -> float:
        """The objective [J] at the current positions."""
        return self.problem.value(self.problem.current)

    @cached_property
    def round_off(self) -> float:
        """How far apart [J] two objectives may lie by round-off alone."""
        return 4 * float(np.finfo(float).eps) * self.problem.magnitude(self.problem.current)

    def stationarity(self, p: Positions) -> float:
        """Of positions (n, 3) [m]; 0 where the step starts at a stationary point."""
        return self._residual(p) / self.yardstick if self.yardstick else 0.0

    def _residual(self, p: Positions) -> float:
        if self._factor is None:
            return 0.0
        gradient = np.ascontiguousarray(self.problem.gradient(p)[self._free])
        step = np.empty_like(gradient)
        self._factor.solve(gradient, step)
        return float(np.sqrt(max(0.0, np.einsum("ij,ij->", gradient, step))))

    def distances(self, p: Positions, other: Positions) -> tuple[float, float]:
        """The largest and the root mean square distance [m] over the vertices that are not pinned."""
        away = np.linalg.norm(p - other, axis=1)[self._free]
        return float(away.max(initial=0.0)), float(np.sqrt(np.mean(away**2))) if len(away) else 0.0


def stiffness_ratio(system: System, stiffness: np.ndarray) -> float:
    """k dt^2/m of the median stiffness (m,) [N/m] and the mean mass of the free vertices; nan without springs."""
    mass = system.mass[system.free]
    if not len(stiffness) or not len(mass) or not mass.any():
        return float("nan")
    return float(np.median(stiffness) * system.time_step**2 / np.mean(mass))
