"""Verification of a scene: its steps agree with an independent reference implementation at random points.

At each point the harness builds one step and takes it, with a solver that returns the point. The comparison covers the
masses, the inertia and its target, the forces, the pins, and the motion after the step. It also covers the energy of
each effect, its gradient and its Hessian along a random direction, and the objective, the sum of all terms. A plug-in
effect has no reference implementation: its energies' gradients are checked against their own values, and its forces,
pins and filters are not checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from harness.scenes.bind import Scene
from harness.scenes.spec import SceneSpec
from harness.simulation.opinion.compare import Finding, Place, differ, energies, pressed, steps
from harness.simulation.opinion.declared import Array
from harness.simulation.opinion.points import SamplePoint, points
from harness.simulation.opinion.sides import Side, side
from harness.simulation.opinion.stages import STAGED, stages
from harness.simulation.opinion.steps import state
from harness.simulation.step import simulate
from solvers.problem import Solution, StepProblem, StopRule

AGREES, DISAGREES, SINGLE = "agrees", "disagrees", "single opinion"


def second_opinion(spec: SceneSpec, scene: Scene, integrator: str) -> str:
    """Compare a scene's terms with the reference implementation.

    Args:
      spec: specification of the scene.
      scene: scene built from it with the integrator.
      integrator: name of the integrator.

    Returns: `agrees`; `disagrees: term, by relative difference; ...`; or `single opinion: effects` where some effects
    have
      no reference implementation.
    """
    with np.errstate(all="ignore"):  # what is not finite is compared like all else
        sides = [side(spec, scene)]
        if scene.alternate:
            sides.append(side(spec.stepped(scene.alternate.system.time_step), scene.alternate))
        found: dict[str, float] = {}
        for point in points(scene, sides[0].declared, spec.frames):
            for finding in _compared(sides, scene, integrator, point):
                found[finding.name] = max(finding.by, found.get(finding.name, 0.0))
    if found:
        worst = sorted(found.items(), key=lambda item: -item[1])
        return f"{DISAGREES}: " + "; ".join(f"{name}, by {by:.2g} of its size" for name, by in worst)
    single = ", ".join(sides[0].name(k) for k in sorted(sides[0].outside))
    return f"{SINGLE}: {single}" if single else AGREES


class _Answer:
    """Substitute for a prepared solver, with a given solution.

    Its solution is x (n, 3) [m] as a function of the time [s]. It returns the velocity at the step's end if
    `moves`.
    """

    def __init__(self, x: Callable[[float], Array], *, moves: bool = False) -> None:
        self.x, self._moves = x, moves

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the given solution of any step."""
        x = self.x(problem.start.until)
        v = problem.start.velocity_at(x) if self._moves else None
        return Solution(x, 0, float("nan"), float("nan"), "iterations", v)


def _compared(sides: list[Side], scene: Scene, integrator: str, point: SamplePoint) -> Iterator[Finding]:
    """Compare all terms at one point."""
    index, now, before = point.state.index, point.state.now, point.state.before
    own = sides[index % len(sides)]
    time = sum(sides[k % len(sides)].declared.time_step for k in range(len(sides))) * (index // len(sides))
    time += sides[0].declared.time_step * (index % len(sides))
    if integrator in STAGED:
        yield from _staged(own, scene, integrator, point, time)
        return
    stated = state(integrator, own.declared, own.opinions, now, before, time)
    m = stated.moment
    x = np.asarray(m.p + m.when * m.time_step * m.v, float) + point.shift
    answer: Any = _Answer(lambda until: x, moves=integrator == "own")
    run = simulate(scene, answer, StopRule(), first_guess="current", frames=index + 1, state=point.state)
    done = next(run)
    at = Place(own, pressed(stated, done.problem, x), done.problem, x, point.direction)
    yield from steps(at)
    p, v = stated.after(x)
    after = done.state
    yield from differ("positions after the step", after.now.positions, p, at.reach)
    yield from differ("velocities after the step", after.now.velocity, v, m.rate * at.reach)
    if after.before is None:
        yield Finding("the motion before (number)", 1.0)
    else:
        yield from differ("positions before", after.before.positions, m.p, at.reach)
        yield from differ("velocities before", after.before.velocity, m.v, at.reach / m.time_step)
    yield from energies(at)


def _staged(own: Side, scene: Scene, integrator: str, point: SamplePoint, time: float) -> Iterator[Finding]:
    """Compare all terms of an integrator with several stages, solved by extrapolation."""
    now, dt = point.state.now, own.declared.time_step

    def x(until: float) -> Array:
        return np.asarray(now.positions + (until - time) * now.velocity + (until - time) / dt * point.shift, float)

    a = point.state.acceleration
    assert a is not None
    wanted = stages(integrator, own.declared, own.opinions, now, a, time, x)
    answer: Any = _Answer(x)
    index = point.state.index
    done = next(simulate(scene, answer, StopRule(), first_guess="current", frames=index + 1, state=point.state))
    if len(done.stages) != len(wanted.stated):
        yield Finding("unknowns of the step (number)", 1.0)
        return
    reach = 0.0
    for (problem, _), stated, answered in zip(done.stages, wanted.stated, wanted.answers, strict=True):
        at = Place(own, pressed(stated, problem, answered), problem, answered, point.direction)
        reach = max(reach, at.reach)
        yield from steps(at)
        yield from energies(at)
    rate = wanted.stated[0].moment.rate
    assert done.state.acceleration is not None
    for name, ours, theirs, size in (
        ("positions after the step", done.state.now.positions, wanted.end[0], reach),
        ("velocities after the step", done.state.now.velocity, wanted.end[1], rate * reach),
        ("acceleration after the step", done.state.acceleration, wanted.acceleration, rate**2 * reach),
    ):
        yield from differ(name, ours, theirs, size)
