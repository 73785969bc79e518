"""Vertex block descent with contact by pairs, on a device: the model's share of a sweep, and steps from row to row.

    g_i.d + 1/2 d'(H_ii + LEAST held_i I) d      of a row that pairs have, with a step d (`solvers.contact.pairs_vbd`)

Rows of positions (N, 3) are those of the mesh, then obstacles' vertices, which stay.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

from numba import float64

from solvers.contact.pairs_vbd import LEAST
from solvers.cuda import vbd_kernels
from solvers.cuda.shared import shared
from solvers.cuda.target import cuda
from solvers.kernels import half_spaces
from solvers.kernels.half_spaces import EXACT, MAJORANT

_solved = shared(half_spaces.solved)


class Model(NamedTuple):
    """By rows: whether there is any (n,), g (n, 3) [N], H_ii (n, 6) and what else holds a vertex (n,) [N/m]."""

    near: Any
    gradient: Any
    block: Any
    held: Any


@cuda.jit(device=True)
def blocked(model, i, base):
    """A block with that of the model added."""
    more = LEAST * model.held[i]
    return (
        base[0] + model.block[i, 0] + more, base[1] + model.block[i, 1], base[2] + model.block[i, 2],
        base[3] + model.block[i, 3] + more, base[4] + model.block[i, 4], base[5] + model.block[i, 5] + more,
    )  # fmt: skip


@cuda.jit
def clear(model):
    """No model."""
    i = cuda.grid(1)
    while i < model.near.shape[0]:
        model.near[i] = False
        for a in range(3):
            model.gradient[i, a] = 0.0
        for a in range(6):
            model.block[i, a] = 0.0
        i += cuda.gridsize(1)


@cuda.jit
def add(x, out):
    """Add x (n, 3) to `out` (f, 3), f <= n."""
    i = cuda.grid(1)
    while i < out.shape[0]:
        for c in range(3):
            out[i, c] += x[i, c]
        i += cuda.gridsize(1)


@cuda.jit
def by_rows(vertex, p, out):
    """Write p, by vertices, to the mesh's rows of `out`."""
    i = cuda.grid(1)
    while i < vertex.shape[0]:
        for c in range(3):
            out[i, c] = p[vertex[i], c]
        i += cuda.gridsize(1)


@cuda.jit
def begin(p, x, u, older, before):
    """Rows of p as a reference (n + 2, 4), from which nothing has moved."""
    i = cuda.grid(1)
    while i < x.shape[0] - 2:
        for c in range(3):
            x[i, c] = p[i, c]
        for c in range(4):
            u[i, c] = older[i, c] = before[i, c] = 0.0
        i += cuda.gridsize(1)


@cuda.jit
def between(p, q, out):
    """Write q - p."""
    i = cuda.grid(1)
    while i < out.shape[0]:
        for c in range(3):
            out[i, c] = q[i, c] - p[i, c]
        i += cuda.gridsize(1)


@cuda.jit
def go(p, t, way, out):
    """Write p + t way."""
    i = cuda.grid(1)
    while i < out.shape[0]:
        for c in range(3):
            out[i, c] = p[i, c] + t * way[i, c]
        i += cuda.gridsize(1)


@cuda.jit
def each(model, g, out):
    """Write each free row's way along its own block, (f, 3); g: the gradient."""
    i = cuda.grid(1)
    while i < g.shape[0]:
        h = model.held[i]
        block = (
            h + model.block[i, 0], model.block[i, 1], model.block[i, 2],
            h + model.block[i, 3], model.block[i, 4], h + model.block[i, 5],
        )  # fmt: skip
        d, _ = _solved(block, (g[i, 0], g[i, 1], g[i, 2]))
        out[i, 0], out[i, 1], out[i, 2] = d
        i += cuda.gridsize(1)


class Kernels(NamedTuple):
    """Kernels in one type of numbers."""

    push: Any


@cache
def kernels(real: Any) -> Kernels:
    """Those of a type, that of displacements."""
    gathered, springs_rise = vbd_kernels.kernels(real).gathered, vbd_kernels.kernels(real).risen_there

    @cuda.jit(device=True)
    def risen(d, where):
        lane, i, model = where
        rise = springs_rise(d, lane)
        b00, b01, b02, b11, b12, b22 = blocked(model, i, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        h0, h1, h2 = b00 * d[0] + b01 * d[1] + b02 * d[2], b01 * d[0] + b11 * d[1] + b12 * d[2], b02 * d[0] + b12 * d[1]
        h2 += b22 * d[2]
        for c in range(3):
            rise += model.gradient[i, c] * d[c]
        return rise + 0.5 * (h0 * d[0] + h1 * d[1] + h2 * d[2])

    lowering = shared(half_spaces.trying(risen))

    @cuda.jit
    def push(
        begin, end, own, start, neighbour, kind, weights, spring, direction, arrows,
        nobody, far, held, majorant, force, u, before, model, spaces,
    ):  # fmt: skip
        """Move those vertices of a colour anew that pairs have, from where they were before its sweep. spaces: of
        obstacles, there are none; see `solvers.cuda.vbd_kernels` for all else."""
        t = begin + cuda.grid(1)
        if t >= end or own[t] == nobody or not model.near[own[t]]:
            return
        i, b = own[t], t // vbd_kernels.LANES
        first, last = start[b], start[b + 1]
        u0, u1, u2 = before[i, 0], before[i, 1], before[i, 2]
        f0, f1, f2, b00, b01, b02, b11, b12, b22, lengthless = gathered(
            t, first, last, u0, u1, u2, neighbour, kind, weights, spring, direction, arrows, far, held, force, u
        )
        gradient = model.gradient[i, 0] - f0, model.gradient[i, 1] - f1, model.gradient[i, 2] - f2
        block = float64(b00), float64(b01), float64(b02), float64(b11), float64(b12), float64(b22)
        most, level = float64(majorant[t]), MAJORANT if lengthless else EXACT
        bound = blocked(model, i, (most, 0.0, 0.0, most, 0.0, most))
        at = float64(u0), float64(u1), float64(u2)
        lane = t, first, last, (u0, u1, u2), (f0, f1, f2), neighbour, kind, weights, arrows, far, held, u
        d = lowering(spaces, i, at, bound, level, gradient, blocked(model, i, block), (lane, i, model))
        u[i, 0], u[i, 1], u[i, 2] = real(u0 + d[0]), real(u1 + d[1]), real(u2 + d[2])

    return Kernels(push)
