"""Translation of unconstrained components, to where inertia and external forces are in equilibrium.

    t = sum over v of (m_v/dt^2 (target_v - p_v) + f_v) / sum over v of m_v/dt^2

Internal forces do not depend on the translation of a whole component and add to zero, so that t minimises the objective
along it: the centre of mass moves as external forces determine. The tolerance of a solve does not enter, and momentum
is conserved in any number of steps.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.kernel_compilation import jit_inner
from springbench.solvers.model.step_problem import System

_ROUNDOFF = 1e-12
"""Largest force on a translated vertex besides its inertia that is round-off, relative to the diagonal of Q."""


class FreeComponents(NamedTuple):
    """Connected components of Q whose translation only inertia resists.

    Attributes:
        starts: first vertex of each component in `vertices`, and the end of the last one (k + 1,).
        vertices: vertices of the components, one after the other.
    """

    starts: NDArray[np.int64]
    vertices: NDArray[np.int64]

    @classmethod
    def from_matrix(cls, system: System, Q: csr_array, labels: NDArray[np.int32]) -> Self:
        """Select the components.

        Args:
            system: provides inertia and pins.
            Q: system matrix (n, n) [N/m].
            labels: connected component of each vertex (n,).
        """
        count = int(labels.max(initial=-1)) + 1
        other = np.abs(Q @ np.ones(len(labels)) - system.inertia_diagonal)
        is_held = (other > _ROUNDOFF * Q.diagonal()) | ~system.unpinned_mask
        is_free = np.bincount(labels, is_held, count) == 0
        order = np.argsort(labels, kind="stable")
        sizes = np.bincount(labels, minlength=count)[is_free]
        return cls(np.concatenate([[0], np.cumsum(sizes)]), order[is_free[labels[order]]])


@jit_inner
def centre_components(components, inertia, target, force, row_of_vertex, x):
    """Translate components to their equilibrium.

    Args:
        components: the components.
        inertia: m/dt^2 of each vertex (n,) [N/m].
        target: inertial target (n, 3) [m].
        force: external force (n, 3) [N].
        row_of_vertex: row of each vertex in x (n,).
        x: positions in rows of four [m], updated.
    """
    for k in range(len(components.starts) - 1):
        begin, end = components.starts[k], components.starts[k + 1]
        total, shift_x, shift_y, shift_z = 0.0, 0.0, 0.0, 0.0
        for i in range(begin, end):
            v = components.vertices[i]
            at, m = 4 * row_of_vertex[v], inertia[v]
            total += m
            shift_x += m * (target[v, 0] - x[at]) + force[v, 0]
            shift_y += m * (target[v, 1] - x[at + 1]) + force[v, 1]
            shift_z += m * (target[v, 2] - x[at + 2]) + force[v, 2]
        for i in range(begin, end):
            at = 4 * row_of_vertex[components.vertices[i]]
            x[at] += shift_x / total
            x[at + 1] += shift_y / total
            x[at + 2] += shift_z / total
