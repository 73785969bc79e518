"""The compiled dual step of augmented vertex block descent: tensions and stiffnesses after each sweep.

    t <- k (l - clip(l, low - t/k, high - t/k)),     k <- min(k + ramp |l - clip(l, low, high)|, most)

For an edge within its limits t is zero, and k does not change.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel


class DualState(NamedTuple):
    """The dual variables and parameters of each edge (m,), updated after sweeps.

    Attributes:
        min_length, max_length: minimum and maximum length in this step [m].
        exact_mask: whether the edge has a tension; otherwise `max_stiffness` is its physical stiffness.
        stiffness_ramp: increase of the stiffness [N/m] per metre of constraint violation.
        max_stiffness: maximum stiffness [N/m].
        max_tension: maximum tension [N].
        stiffness: current stiffness [N/m].
        tension: current tension [N].
        base_majorant: majorant of all other energies (rows,).
        majorant_scratch: scratch for the majorant with the edges (rows,).
    """

    min_length: NDArray[np.float64]
    max_length: NDArray[np.float64]
    exact_mask: NDArray[np.bool_]
    stiffness_ramp: NDArray[np.float64]
    max_stiffness: NDArray[np.float64]
    max_tension: NDArray[np.float64]
    stiffness: NDArray[np.float64]
    tension: NDArray[np.float64]
    base_majorant: NDArray[np.float64]
    majorant_scratch: NDArray[np.float64]


@jit_inner
def _clip(x, low, high):
    return min(max(x, low), high)


@jit_kernel
def write_edge_parameters(blocks, hard, duals, p):
    """Write the edges' stiffnesses and shifted limits, and the vertex majorants.

    If an edge pulls with t, the stiffness of a transverse step is at most t/l.

    Args:
        blocks: packets of the vertices; `majorant` (lanes,) [N/m] is overwritten.
        hard: the edges (m,); columns 0 to 2 of `parameters` get stiffness [N/m], minimum and maximum length [m].
        duals: tensions and stiffnesses of the edges; `majorant_scratch` is overwritten.
        p: positions [m] in rows of four.
    """
    for row in range(len(duals.base_majorant)):
        duals.majorant_scratch[row] = duals.base_majorant[row]
    for e in range(len(duals.min_length)):
        k, t = duals.stiffness[e], duals.tension[e]
        hard.parameters[e, 0], hard.parameters[e, 1], hard.parameters[e, 2] = (
            k,
            duals.min_length[e] - t / k,
            duals.max_length[e] - t / k,
        )
        i, j = hard.element_rows[e, 0], hard.element_rows[e, 1]
        if i != j:
            share = k + max(t, 0.0) / max(_edge_length(hard, e, p), 0.01 * duals.max_length[e])
            duals.majorant_scratch[i] += share
            duals.majorant_scratch[j] += share
    for lane in range(len(blocks.majorant)):
        blocks.majorant[lane] = duals.majorant_scratch[blocks.spring_packets.row_offset[lane] // 4]


@jit_inner
def _edge_length(hard, e, p):
    i, j = 4 * hard.element_rows[e, 0], 4 * hard.element_rows[e, 1]
    return np.sqrt((p[i] - p[j]) ** 2 + (p[i + 1] - p[j + 1]) ** 2 + (p[i + 2] - p[j + 2]) ** 2)


@jit_inner
def _update_duals(hard, duals, p):
    """Do the dual step at p."""
    for e in range(len(duals.min_length)):
        k, length = duals.stiffness[e], _edge_length(hard, e, p)
        force = k * (length - _clip(length, hard.parameters[e, 1], hard.parameters[e, 2]))
        if duals.exact_mask[e]:
            duals.tension[e] = _clip(force, -duals.max_tension[e], duals.max_tension[e])
        if force != 0.0:
            off = abs(length - _clip(length, duals.min_length[e], duals.max_length[e]))
            duals.stiffness[e] = min(k + duals.stiffness_ramp[e] * off, duals.max_stiffness[e])


@cache
def build_augmented_iteration(sweeps: Any) -> Any:
    """Build the iteration over a kernel of sweeps, `vbd_sweeps.run_iterations` or one for elements."""

    @jit_kernel
    def iterate(blocks, spaces, elements, right, work, p, iterations, hard, duals):
        """Run n sweeps, each with a dual step, from p, which is overwritten.

        The edge parameters must be current.
        """
        for _ in range(iterations):
            sweeps(blocks, spaces, elements, right, 0.0, work, p, 1)
            _update_duals(hard, duals, p)
            write_edge_parameters(blocks, hard, duals, p)

    return iterate
