"""Scales of frozen steps: what two energies differ by at least, how far two points are apart, how stiff a step is."""

from __future__ import annotations

import numpy as np

from solvers.problem import Positions, StepProblem, System
from solvers.round_off import EPS


def round_off(problem: StepProblem) -> float:
    """How far apart [J] two objectives may lie by round-off alone."""
    return 4.0 * EPS * problem.magnitude(problem.current)


def distances(system: System, p: Positions, other: Positions) -> tuple[float, float]:
    """The largest and the root mean square distance [m] over the vertices that are not exactly pinned."""
    away = np.linalg.norm(p - other, axis=1)[system.free]
    return float(away.max(initial=0.0)), float(np.sqrt((away**2).mean())) if len(away) else 0.0


def stiffness_ratio(system: System, stiffness: np.ndarray) -> float:
    """k dt^2/m of the median stiffness (m,) [N/m] and the mean mass of the free vertices; nan without springs."""
    mass = system.mass[system.free]
    if not len(stiffness) or not len(mass) or not mass.any():
        return float("nan")
    return float(np.median(stiffness) * system.time_step**2 / np.mean(mass))
