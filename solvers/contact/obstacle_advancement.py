"""An intersection-free start of a step in which obstacles move.

The mesh is intersection-free at the start of the step for the obstacles' old positions. The minimiser needs a start
that is intersection-free for their positions at the end of the step. These motions are tried first, each on a straight
path while the obstacles move: no motion, motion with the current velocity, and rigid motion with an obstacle. If none
is free of collisions to the end, the one with the largest fraction is followed, and then the barriers themselves push
nearby vertices away from obstacles at rest:

    p <- p + t d,     d_i = -1/2 B_i^-1 g_i,     B_i = 3 x 3 blocks of the barriers' Hessian, plus inertia

Here g is the gradient of the barriers only, and t is the collision-free step size. Then the obstacles advance. The
result is a start, not a solution: it affects the end of the step only by the choice among several minima.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from springbench.solvers.model.barrier_energy import BarrierEnergy, is_barrier_energy, max_step_size
from springbench.solvers.model.step_problem import Positions, StepProblem

_MAX_ROUNDS, _PUSHES_PER_ROUND = 400, 6
"""Maximum number of rounds in which obstacles advance, and pushes per round."""

_SAFE_FRACTION = 0.9
"""Fraction of a collision-free displacement that is used, which leaves a gap for the pushes."""


class NoClearance(Exception):
    """An error for obstacles that leave no intersection-free start; the message states the fraction reached."""


def intersection_free_guess(problem: StepProblem) -> StepProblem:
    """Return the problem with intersection-free current positions and initial guess.

    Each is replaced by the start of the step unless the straight path from there to it is free of collisions. If
    obstacles move, the path must avoid them, and the start itself may be pushed away. A problem without barrier
    energies is returned unchanged.

    Raises:
        NoClearance: no intersection-free start was found.
    """
    if not any(map(is_barrier_energy, problem.system.energies)):
        return problem
    energies = [energy for energy in problem.energies if is_barrier_energy(energy)]
    p = problem.step_start.positions

    def is_free(q: Positions) -> bool:
        return all(energy.collision_free_step_size_moving(p, q - p, 0.0) == 1.0 for energy in energies)

    @cache
    def find_start() -> Positions:
        rest = np.zeros_like(p)
        if is_free(p) or not all(
            energy.at_fraction(0.0).collision_free_step_size(p, rest) == 1.0 for energy in energies
        ):
            return p
        return _find_clear_positions(problem, energies)

    current = problem.current_positions if is_free(problem.current_positions) else find_start()
    guess = current
    if problem.initial_guess is not problem.current_positions:
        guess = problem.initial_guess if is_free(problem.initial_guess) else find_start()
    if current is problem.current_positions and guess is problem.initial_guess:
        return problem
    return replace(problem, current_positions=current, initial_guess=guess)


def _find_clear_positions(problem: StepProblem, energies: Sequence[BarrierEnergy]) -> Positions:
    """Return intersection-free positions (n, 3) [m] at the step's end, by a collision-free path.

    Raises NoClearance if none is found.
    """
    p, part = problem.step_start.positions, 0.0
    exact = problem.system.pins.vertices[problem.system.pins.exact_mask]
    ends = [p, p + problem.system.time_step * problem.step_start.velocity]
    ends += [q for energy in energies for q in energy.comoving_positions(p)]
    for _ in range(_MAX_ROUNDS):
        most, along = 0.0, np.zeros_like(p)
        for shift in [np.zeros_like(p)] + [(1.0 - part) * (q - problem.step_start.positions) for q in ends[1:]]:
            shift[exact] = 0.0
            t = min(energy.collision_free_step_size_moving(p, shift, part) for energy in energies)
            if t > most:
                most, along = t, shift
            if t == 1.0:
                return p + shift
        p, part = p + _SAFE_FRACTION * most * along, part + _SAFE_FRACTION * most * (1.0 - part)
        waiting = [energy.at_fraction(part) for energy in energies]
        for _ in range(_PUSHES_PER_ROUND):
            p = _push_out(problem, waiting, p)
    raise NoClearance(
        f"obstacles leave no room: the vertices in their path could be moved out of it for {part:.3g} of the step's "
        "length; reduce their motion per step, or use a smaller step size"
    )


def _push_out(problem: StepProblem, energies: Sequence[BarrierEnergy], p: Positions) -> Positions:
    """Return p (n, 3) after one push."""
    system = problem.system
    gradient, curvature = np.zeros_like(p), np.zeros((len(p), 3, 3))
    for energy in energies:
        energy.add_gradient(p, gradient)
        blocks = energy.hessian_blocks(p, 0.0)
        k = blocks.vertices.shape[1]
        places = np.full((len(blocks.vertices), k * k), -1)
        places[:, :: k + 1] = blocks.vertices
        blocks.add_blocks(places, curvature)
    # A vertex without inertia gets a small one, so that no block is singular.
    diagonal = np.maximum(system.inertia_diagonal, 1e-9 * float(curvature.max(initial=0.0)) or 1.0)
    curvature += diagonal[:, None, None] * np.eye(3)
    shift = np.asarray(-0.5 * np.linalg.solve(curvature, gradient[:, :, None])[:, :, 0], np.float64)
    shift[system.pins.vertices[system.pins.exact_mask]] = 0.0
    return p + max_step_size(energies, p, shift) * shift
