"""The terms of a step that act on single vertices: inertia, force and penalty pins.

    h_i/2 |p_i|^2 - y_i . p_i,      h = c m/dt^2 + w,      y = c m/dt^2 target + f + w p_pin

They form one quadratic function per vertex. So methods that proceed vertex by vertex or spring by spring treat a pin of
any weight exactly, by an increased weight of the vertex, without a further slowly converging constraint.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.model.step_problem import Positions, StepProblem, System, Unsupported


def compute_anchor_stiffness(system: System) -> NDArray[np.float64]:
    """Return the stiffness h (n,) [N/m] of inertia and pins, infinite for an exact pin."""
    total = system.inertia_diagonal.copy()
    total[system.pins.vertices] += system.pins.weight
    return total


def compute_anchor_positions(problem: StepProblem) -> Positions:
    """Return the minimiser y/h (n, 3) [m] of these terms.

    Exact pins are on their targets. The minimiser is computed as target + (f + w (p_pin - target))/h, which avoids
    rounding if the force is small.
    """
    s = problem.system
    weight, away = np.zeros(s.num_vertices), problem.external_force.copy()
    soft, vertices, weights = s.penalty_pins
    weight[vertices] = weights
    away[vertices] += weights[:, None] * (problem.pin_targets[soft] - problem.inertial_target[vertices])
    return apply_exact_pins(problem.inertial_target + away / compute_anchor_stiffness(s)[:, None], problem)


def apply_exact_pins(p: Positions, problem: StepProblem) -> Positions:
    """Return a copy of positions with the exactly pinned vertices on their targets.

    Args:
        p: positions (n, 3) [m].
        problem: the step, with pins and targets.
    """
    out = np.array(p, np.float64, order="C")
    indices, vertices = problem.system.exact_pins
    if len(vertices):
        out[vertices] = problem.pin_targets[indices]
    return out


def require_mass(system: System, anchor_stiffness: NDArray[np.float64], solver: str) -> None:
    """Check that each vertex has mass or a pin.

    Args:
        system: the system, for the message.
        anchor_stiffness: anchor stiffness [N/m] or mass [kg] of each vertex (n,), positive where it suffices.
        solver: name of the solver, for the message.

    Raises:
        Unsupported: with the vertices concerned.
    """
    loose = np.flatnonzero(anchor_stiffness <= 0.0)
    if len(loose):
        named = ", ".join(map(str, loose[:5])) + (", ..." if len(loose) > 5 else "")
        raise Unsupported(
            f"{solver}: moves each vertex by its own mass; {len(loose)} of {system.num_vertices} have none and are not "
            f"pinned ({named}): give them mass, or use a solver such as numba"
        )


def require_implicit_euler(system: System, solver: str) -> None:
    """Check that the step is that of implicit Euler.

    Args:
        system: the system; another integrator has an inertia factor other than 1.
        solver: name of the solver, for the message.

    Raises:
        Unsupported: the step is that of another integrator.
    """
    if system.inertia_factor != 1.0:
        raise Unsupported(
            f"{solver}: divides the step itself and returns its own velocity, so that the integrator has no effect; "
            "use the integrator implicit-euler"
        )
