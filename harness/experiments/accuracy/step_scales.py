"""Scales of step snapshots: energy round-off, distances between positions, and stiffness ratio."""

from __future__ import annotations

import numpy as np
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions, StepProblem, System


def compute_energy_roundoff(problem: StepProblem) -> float:
    """Return the difference of two objectives that round-off alone may cause [J]."""
    return 4.0 * EPS * problem.value_scale(problem.current_positions)


def compute_vertex_distances(system: System, p: Positions, other: Positions) -> tuple[float, float]:
    """Return the largest and the root-mean-square distance over the free vertices [m].

    Args:
        system: system whose free vertices count.
        p, other: positions (n, 3) [m].
    """
    away = np.linalg.norm(p - other, axis=1)[system.free_vertices]
    return float(away.max(initial=0.0)), float(np.sqrt((away**2).mean())) if len(away) else 0.0


def compute_stiffness_ratio(system: System, stiffness: np.ndarray) -> float:
    """Return k dt^2/m of the median stiffness and the mean mass.

    Args:
        system: system with the time step, and with the masses, of which those of the free vertices count.
        stiffness: stiffness of the springs (m,) [N/m].

    Returns:
        The dimensionless ratio; nan without springs or masses.
    """
    mass = system.mass[system.free_vertices]
    if not len(stiffness) or not len(mass) or not mass.any():
        return float("nan")
    return float(np.median(stiffness) * system.time_step**2 / np.mean(mass))
