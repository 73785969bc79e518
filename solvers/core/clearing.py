"""How a mesh makes way for obstacles that move within a step, so that the step starts free where they then are.

The start of a step is free where obstacles were; the minimiser has to start where it is free of obstacles as they are
at the step's end. Tried first, each along the straight way while the obstacles go theirs: to rest, to go on as before,
to move with an obstacle as if it were fixed to it. Where none is free all the way, the one that leads farthest is gone
so far, and what is near is pushed apart by the barriers themselves, at obstacles that wait:

    p <- p + t d,     d_i = -1/2 B_i^-1 g_i,     B_i = 3 x 3 blocks of the barriers' Hessian, plus inertia

g is the gradient of the barriers alone; t is the largest that is safe. Then obstacles go on. What is found is a start
and no solution: it has no share in what the step ends at, but for which of several minima is near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from solvers.core.bounds import Bounded, is_bounded, reach
from solvers.problem import Positions, StepProblem

_ROUNDS, _PUSHES = 400, 6
"""Of obstacles that go on, and of pushes between."""

_OPEN = 0.9
"""Of a way that is safe: so much of it is gone, which leaves room to be pushed apart."""


class Blocked(Exception):
    """What moves within a step leaves the mesh no way to where the step could start; the message says how far."""


def begun_free(problem: StepProblem) -> StepProblem:
    """The same problem, its current positions and its first guess where the step starts unless the straight way from
    there to them is free; itself without such energies. Where obstacles move, the way leads past them, and where the
    step starts may have to make way. Raises Blocked where it cannot."""
    energies = [energy for energy in problem.energies if is_bounded(energy)]
    if not energies:
        return problem
    p = problem.start.positions

    def free(q: Positions) -> bool:
        return all(energy.carried(p, q - p, 0.0) == 1.0 for energy in energies)

    start, rest = p, np.zeros_like(p)
    if not free(p) and all(energy.at_part(0.0).largest_step(p, rest) == 1.0 for energy in energies):
        start = _cleared(problem, energies)
    current = problem.current if free(problem.current) else start
    guess = current
    if problem.first_guess is not problem.current:
        guess = problem.first_guess if free(problem.first_guess) else start
    return replace(problem, current=current, first_guess=guess)


def _cleared(problem: StepProblem, energies: Sequence[Bounded]) -> Positions:
    """Positions (n, 3) [m] that are free of intersections with obstacles at the step's end, by a way from the step's
    start that is free at all times. Raises Blocked where none is found."""
    p, part = problem.start.positions, 0.0
    exact = problem.system.pins.vertices[problem.system.pins.exact]
    ends = [p, p + problem.system.time_step * problem.start.velocity]
    ends += [q for energy in energies for q in energy.with_obstacles(p)]
    for _ in range(_ROUNDS):
        most, along = 0.0, np.zeros_like(p)
        for way in [np.zeros_like(p)] + [(1.0 - part) * (q - problem.start.positions) for q in ends[1:]]:
            way[exact] = 0.0
            t = min(energy.carried(p, way, part) for energy in energies)
            if t > most:
                most, along = t, way
            if t == 1.0:
                return p + way
        p, part = p + _OPEN * most * along, part + _OPEN * most * (1.0 - part)
        waiting = [energy.at_part(part) for energy in energies]
        for _ in range(_PUSHES):
            p = _pushed(problem, waiting, p)
    raise Blocked(
        f"obstacles leave no room: what is in their way could be moved out of it for {part:.3g} of the step's length; "
        "move them less in a step, or take shorter steps"
    )


def _pushed(problem: StepProblem, energies: Sequence[Bounded], p: Positions) -> Positions:
    """p (n, 3) after one push."""
    system = problem.system
    gradient, curvature = np.zeros_like(p), np.zeros((len(p), 3, 3))
    for energy in energies:
        energy.add_gradient(p, gradient)
        blocks = energy.blocks(p, 0.0)
        k = blocks.vertices.shape[1]
        places = np.full((len(blocks.vertices), k * k), -1)
        places[:, :: k + 1] = blocks.vertices
        blocks.add(places, curvature)
    held = np.maximum(system.inertia, 1e-9 * float(curvature.max(initial=0.0)) or 1.0)
    curvature += held[:, None, None] * np.eye(3)
    way = np.asarray(-0.5 * np.linalg.solve(curvature, gradient[:, :, None])[:, :, 0], np.float64)
    way[system.pins.vertices[system.pins.exact]] = 0.0
    return p + reach(energies, p, way) * way
