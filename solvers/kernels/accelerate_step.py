"""A whole accelerated step over a factor's own rows, without Python, for springs and spring-like energies.

The plan is that of `solvers.kernels.step`, which corrects positions within the solve. Here a solve is
separate, because the acceptance of a trial depends on its objective.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel
from solvers.kernels.accelerate import AGAIN, STALLED, Window, accept, begin, judge, propose
from solvers.kernels.accelerate_springs import Shares, descend
from solvers.kernels.edges import descend_edges
from solvers.kernels.loop import compiled_over
from solvers.kernels.springs import Bundles, squared_norm
from solvers.kernels.step import Plan
from solvers.kernels.step_ends import VertexRows, fetch, place, state
from solvers.linear.supernodal_solve import backwards, forwards

NOISE = 4.0 * np.finfo(np.float64).eps
"""A bound on the relative rounding error of one term of a sum. The bound on the whole sum adds up those of its terms.
The true errors partly cancel, so that for n terms the bound is about sqrt(n) times too large."""


class Step(NamedTuple):
    """The plan, packets, objective weights and rows of a system, with vectors of all rows.

    The vectors are y, the solution (in the factor's type) and scratch (zero except in unknown rows). The objective
    values (3,) [J] are the objective at the position, the scale of its cancellation, and its initial negative part.

    The objective is a sum of squares a^2/2, where each a is a difference of two numbers of size A and so has the error
    eps A. The sum has the error eps (sum of a A), at most eps sqrt(2 g size), with size the sum of A^2. If some squares
    have a negative sign, g is the sum of the absolute terms.
    """

    plan: Plan
    bundles: Bundles
    form: Bundles
    shares: Shares
    rows: VertexRows
    right: NDArray[np.float64]
    x: NDArray[Any]
    e: NDArray[np.float64]
    objective: NDArray[np.float64]


@kernel
def start(step: Step, edges, window: Window, target, force, pin_targets, guess):
    """Start the solve of a step; edges: strain limits and dashpots, or None."""
    state(step.rows, target, force, pin_targets, step.right)
    place(step.rows, guess, pin_targets, window.trial)
    step.objective[0] = _evaluate(step, edges, window)
    size = step.shares.size
    for k in range(len(window.direction)):
        size += step.plan.held[k // 4] * window.trial[k] ** 2
    step.objective[1] = size
    _solve(step.plan, window.descent_there, len(window.direction), step.x)
    begin(window, step.x)
    window.now[0].fallen = 0.0


@inner
def _advance(state):
    step, edges, window = state
    now, there, verdict = window.now[0], 0.0, AGAIN
    propose(window)
    while verdict == AGAIN:
        there = _evaluate(step, edges, window)
        before, size = abs(step.objective[0]) + 2.0 * step.objective[2], step.objective[1]
        now.rise, now.noise = there - step.objective[0], NOISE * (before + np.sqrt(2.0 * before * size))
        verdict = judge(window)
    if verdict == STALLED:
        return False
    step.objective[0] = there
    _solve(step.plan, window.descent_there, len(window.direction), step.x)
    accept(window, step.x)
    return True


@inner
def _evaluate(step, edges, window):
    rows = len(window.direction) // 4
    total = descend(step.bundles, step.shares, window.trial, step.right, window.descent_there)
    return total + descend_edges(edges, rows, window.trial, window.descent_there)


@inner
def _residual(state):
    """Return |c|_Q [J^(1/2)] over the unpinned vertices."""
    step, _, window = state
    for i in range(len(window.correction) // 4):
        for k in range(4 * i, 4 * i + 3):
            step.e[k] = step.plan.loose[i] * window.correction[k]
    return np.sqrt(squared_norm(step.form, 0, len(step.form.start) - 1, step.e, step.plan.measure))


_iterate = compiled_over(_advance, _residual)


@kernel
def run(step: Step, edges, window: Window, limits, out):
    """Run the iteration loop (see `solvers.kernels.loop`) and write the positions to `out` (n, 3)."""
    answer = _iterate((step, edges, window), limits)
    fetch(step.rows, window.position, out)
    return answer


@inner
def _solve(plan, b, size, x):
    """Solve Q x = b in rows: groups forwards, the top, groups backwards (see `triangular_solve`)."""
    top, top_end, groups = plan.top
    copied = 4 * (top_end - top)
    for k in range(size):
        x[4 * plan.shift + k] = b[k]
    for group in range(groups):
        copy = 4 * top + (group + 1) * copied
        for k in range(copied):
            x[copy + k] = 0.0
        for block in range(plan.of_group[group], plan.of_group[group + 1]):
            _, _, _, _, chunk, end, _ = plan.blocks[block]
            forwards(plan.panels, plan.places, plan.chunks, chunk, end, x)
    for k in range(4 * top, 4 * top + copied):
        for group in range(groups):
            x[k] += x[k + (group + 1) * copied]
    for block in range(plan.of_group[-2], plan.of_group[-1]):
        _, _, _, _, chunk, middle, end = plan.blocks[block]
        forwards(plan.panels, plan.places, plan.chunks, chunk, middle, x)
        backwards(plan.squares, plan.panels, plan.places, plan.chunks, chunk, end, x)
    for group in range(groups):
        copy = 4 * top + (group + 1) * copied
        for k in range(copied):
            x[copy + k] = x[4 * top + k]
        for block in range(plan.of_group[group + 1] - 1, plan.of_group[group] - 1, -1):
            _, _, _, _, chunk, _, end = plan.blocks[block]
            backwards(plan.squares, plan.panels, plan.places, plan.chunks, chunk, end, x)
