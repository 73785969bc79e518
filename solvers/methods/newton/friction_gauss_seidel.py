"""Friction and contact of Newton's methods between their steps, where a quadratic model is inaccurate.

A half-space acts from its surface on, and a sticking vertex begins to slip after 1e-8 m. There are two remedies:

Friction is relaxed at each trial point, by nonlinear Gauss-Seidel sweeps over the vertices with friction. This is the
smoother of the truncated nonsmooth Newton method (Gräser and Sander 2019). The local problems are solved exactly,
since h (`springbench.solvers.contact.potentials.friction_law`) permits a closed form:

    u <- argmin F h(|u|) + Q_ii/2 |u - v|^2,   v = u - r/Q_ii tangentially,   r <- r + Q (u - previous u)

r is the gradient without friction's own part. Q majorises all else, so that no sweep increases the objective.

A step that ends in half-spaces which were inactive at its start may increase the objective. It is not shortened to end
before them, one after the other. Instead a few more steps with them active follow, until one ends below the start of
the first (watchdog technique, Chamberlain, Powell, Lemarechal and Pedersen 1982; as an active set method, Hintermüller,
Ito and Kunisch 2003).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact
from springbench.solvers.contact.potentials.friction_law import (
    friction_proximal_factor,
    friction_stiffness,
    project_tangentially,
)
from springbench.solvers.iteration.descent_method import (
    ARMIJO_FRACTION,
    DescentPoint,
    ResidualMetric,
    backtracking_line_search,
    inner_product,
)
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.objective.step_objective import StepObjective

_NUM_SWEEPS = 4
_WATCHDOG_STEPS = 4
"""Number of additional steps in the watchdog technique."""

NewtonDirection = Callable[[DescentPoint], Positions | None]
"""Function that returns the Newton direction at a point; None if the Hessian would have to be modified."""


class FreeVertexMatrix(NamedTuple):
    """Q over the free vertices.

    Attributes:
        free_index: index of each vertex among the free ones, or -1, (n,).
        row_starts, columns, entries: rows by free index, columns by vertex.
        diagonal: diagonal of Q.
    """

    free_index: NDArray[np.int64]
    row_starts: NDArray[np.int64]
    columns: NDArray[np.int64]
    entries: NDArray[np.float64]
    diagonal: NDArray[np.float64]


class FrictionGaussSeidel:
    """Friction relaxation and watchdog search of Newton's methods, for one system."""

    def __init__(self, metric: ResidualMetric) -> None:
        Q, free = metric.free_block, metric.system.free_vertices
        number = np.full(metric.system.num_vertices, -1)
        number[free] = np.arange(len(free))
        self._matrix = FreeVertexMatrix(
            number, Q.indptr.astype(np.int64), free[Q.indices], Q.data, metric.free_diagonal
        )

    def relax_friction(self, step: StepObjective, p: Positions) -> Positions:
        """Return a copy of p with friction relaxed; p itself without friction.

        Args:
            step: objective of the step, whose half-spaces may have friction.
            p: positions (n, 3) [m], not modified.
        """
        out = p
        for one in _active_contacts(step):
            planes = one.active_planes
            if planes.friction_limit.any():
                out = p.copy() if out is p else out
                sweep_friction(planes, one.smoothing_length, self._matrix, out, step.gradient(out), _NUM_SWEEPS)
        return out

    def relax_initial_point(self, step: StepObjective, at: DescentPoint) -> DescentPoint:
        """Relax friction at the initial point, if that decreases the objective.

        Args:
            step: objective of the step.
            at: initial point of the solve.

        Returns:
            The relaxed point with its gradient, or `at` itself.
        """
        p = self.relax_friction(step, at.positions)
        return (
            at
            if p is at.positions or step.objective_change(at.positions, p)[0] >= 0.0
            else DescentPoint(p, step.gradient(p))
        )

    def watchdog_search(
        self, step: StepObjective, at: DescentPoint, direction: Positions, newton_direction: NewtonDirection
    ) -> DescentPoint | None:
        """Return a lower point along a direction or after watchdog steps, or None.

        Args:
            step: objective of the step.
            at: current point.
            direction: Newton direction at the point (n, 3) [m].
            newton_direction: returns the direction at later points.
        """
        return self._take_watchdog_steps(step, at, direction, newton_direction) or self._line_search(
            step, at, direction
        )

    def _line_search(self, step: StepObjective, at: DescentPoint, direction: Positions) -> DescentPoint | None:
        return backtracking_line_search(step, at, direction, relax_locally=lambda p: self.relax_friction(step, p))

    def _take_watchdog_steps(
        self, step: StepObjective, origin: DescentPoint, direction: Positions, newton_direction: NewtonDirection
    ) -> DescentPoint | None:
        """Take full Newton steps while each activates further half-spaces.

        Return a point lower than the origin, or None.
        """
        at, enough = origin, ARMIJO_FRACTION * inner_product(origin.gradient, direction)
        for _ in range(_WATCHDOG_STEPS):
            p = self.relax_friction(step, step.apply_exact_pins(at.positions + direction))
            if step.objective_change(origin.positions, p)[0] <= enough:
                return DescentPoint(p, step.gradient(p))
            if not (_active_plane_mask(step, p) & ~_active_plane_mask(step, at.positions)).any():
                found = None if at is origin else self._line_search(step, at, direction)
                return (
                    found if found and step.objective_change(origin.positions, found.positions)[0] <= enough else None
                )
            at = DescentPoint(p, step.gradient(p))
            following = newton_direction(at)
            if following is None:
                return None
            direction = following
        return None


def _active_contacts(step: StepObjective) -> list[HalfSpaceContact]:
    return [
        energy
        for energy in step.problem.energies
        if isinstance(energy, HalfSpaceContact) and not energy.has_no_active_collisions()
    ]


def _active_plane_mask(step: StepObjective, p: Positions) -> NDArray[np.bool_]:
    """Return a mask of the half-spaces that are active at p."""
    return np.concatenate([one.compute_gaps(p) < 0.0 for one in _active_contacts(step)])


@jit_kernel
def sweep_friction(planes, smoothing_length, matrix, p, gradient, sweeps):
    """Relax friction by Gauss-Seidel sweeps over the vertices with friction.

    These are the vertices of half-spaces with a friction limit F > 0.

    Args:
        planes: contact planes.
        smoothing_length: of friction [m].
        matrix: Q over the free vertices.
        p: positions (n, 3) [m], moved tangentially to the normals.
        gradient: gradient at p (n, 3) [N] including friction's own part; updated.
        sweeps: number of sweeps.
    """
    vertices, normal, _, anchor, _, friction_force = planes
    number, starts, columns, entries, diagonal = matrix
    for _ in range(sweeps):
        for e in range(len(friction_force)):
            i = vertices[e]
            f = number[i]
            if friction_force[e] <= 0.0 or f < 0:
                continue
            n0, n1, n2, q = normal[e, 0], normal[e, 1], normal[e, 2], diagonal[f]
            u0, u1, u2 = project_tangentially(
                p[i, 0] - anchor[e, 0], p[i, 1] - anchor[e, 1], p[i, 2] - anchor[e, 2], n0, n1, n2
            )
            g0, g1, g2 = project_tangentially(gradient[i, 0], gradient[i, 1], gradient[i, 2], n0, n1, n2)
            weight = friction_stiffness(friction_force[e], np.sqrt(u0 * u0 + u1 * u1 + u2 * u2), smoothing_length)
            v0, v1, v2 = u0 - (g0 - weight * u0) / q, u1 - (g1 - weight * u1) / q, u2 - (g2 - weight * u2) / q
            length = np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            factor = friction_proximal_factor(friction_force[e], q, length, smoothing_length)
            d0, d1, d2 = factor * v0 - u0, factor * v1 - u1, factor * v2 - u2
            after = friction_stiffness(friction_force[e], factor * length, smoothing_length)
            p[i, 0], p[i, 1], p[i, 2] = p[i, 0] + d0, p[i, 1] + d1, p[i, 2] + d2
            gradient[i, 0] += after * factor * v0 - weight * u0
            gradient[i, 1] += after * factor * v1 - weight * u1
            gradient[i, 2] += after * factor * v2 - weight * u2
            for k in range(starts[f], starts[f + 1]):
                j, w = columns[k], entries[k]
                gradient[j, 0] += w * d0
                gradient[j, 1] += w * d1
                gradient[j, 2] += w * d2
