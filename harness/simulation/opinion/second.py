"""The second opinion of a scene: whether two ways to write its steps agree at random points.

At each point the harness states one step and does it, with a solver that answers the point. Compared are the masses, the
inertia and its target, the forces, the pins, the motion after the step; the energy of each effect, its gradient and its
Hessian along a random direction; and the objective that all add up to. An effect from outside has no second opinion: its
energies' gradients are held against their own values, and its forces, pins and filters are taken as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.effects.table import EFFECTS
from harness.scene import Scene
from harness.simulate import simulate
from harness.simulation.opinion import contact, edges, forces, surfaces, vertices
from harness.simulation.opinion.declared import Array, Begin, Declared, Opinion
from harness.simulation.opinion.derivatives import EPS, ROUNDINGS, Told, tell, wide
from harness.simulation.opinion.motion import blur
from harness.simulation.opinion.outside import from_outside, own_slope, resistance
from harness.simulation.opinion.points import Point, points
from harness.simulation.opinion.steps import Stated, state
from harness.spec import SceneSpec
from solvers.problem import Energy, Solution, StepProblem, StopRule

AGREES, DISAGREES, SINGLE = "agrees", "disagrees", "single opinion"

_OPINIONS = {
    "air-drag": vertices.air_drag,
    "attachments": vertices.attachments,
    "bending": surfaces.bending,
    "constant-force": forces.constant_force,
    "contact": contact.contact,
    "dashpots": edges.dashpots,
    "ether-drag": vertices.ether_drag,
    "gas": surfaces.gas,
    "gravity": forces.gravity,
    "pins": vertices.pins,
    "rayleigh": vertices.rayleigh,
    "springs": edges.springs,
    "strain-limits": edges.strain_limits,
    "wind": forces.wind,
}
_LARGEST_EXACT = 1000
"""Vertices up to which the Hessian of gas is exact, as it says itself."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Two figures of one thing that should be the same, their distance in parts of their size."""

    name: str
    by: float


@dataclass(frozen=True, eq=False)
class _Side:
    """One length of step: what the scene declares, the opinion of each effect, which of the scene's energies are its
    own, and which effects come from outside."""

    declared: Declared
    opinions: list[Opinion]
    begins: list[Begin | None]
    owned: list[list[int]]
    outside: set[int]

    def name(self, k: int) -> str:
        return f"effects[{k}] {self.declared.effects[k].kind}"


def second_opinion(spec: SceneSpec, scene: Scene, integrator: str) -> str:
    """`agrees`; `disagrees: what, by how much; ...`; or `single opinion: effects` where there is no second one.

    scene: what was built of the spec with the integrator of that name.
    """
    with np.errstate(all="ignore"):
        sides = {scene: _side(spec, scene)}
        if scene.alternate:
            sides[scene.alternate] = _side(spec.stepped(scene.alternate.system.time_step), scene.alternate)
        found: dict[str, float] = {}
        for point in points(scene, sides[scene].declared, spec.frames):
            for finding in _compared(sides, scene, integrator, point):
                found[finding.name] = max(finding.by, found.get(finding.name, 0.0))
    if found:
        worst = sorted(found.items(), key=lambda item: -item[1])
        return f"{DISAGREES}: " + "; ".join(f"{name}, by {by:.2g} of its size" for name, by in worst)
    side = sides[scene]
    single = ", ".join(side.name(k) for k in sorted(side.outside))
    return f"{SINGLE}: {single}" if single else AGREES


def _side(spec: SceneSpec, scene: Scene) -> _Side:
    mesh, n = scene.mesh, len(scene.mesh.rest)
    mass = mesh.mass if spec.mass is None else spec.mass * mesh.shares
    declared = Declared(mesh, np.asarray(mass), spec.time_step, tuple(spec.effects))
    bound = [effect.bind(mesh, declared.mass, spec.time_step) for effect in spec.effects]
    # In the order in which a scene lines them up: each effect's, then what follows from all of those.
    first = [energy for part in bound for energy in part.energies]
    owners = [k for k, part in enumerate(bound) for _ in part.energies]
    owners += [k for k, part in enumerate(bound) for derive in part.derived for _ in derive(first)]
    owned = [[i for i, owner in enumerate(owners) if owner == k] for k in range(len(bound))]
    outside = {k for k, effect in enumerate(spec.effects) if not _known(effect)}
    if any(owned[k] for k in outside):  # of whose energies nobody knows what Rayleigh damping makes
        outside |= {k for k, effect in enumerate(spec.effects) if effect.kind == "rayleigh" and effect.stiffness}
    opinions = [
        from_outside(bound[k]) if k in outside else _opinion(effect, bound[k].empty, declared)
        for k, effect in enumerate(spec.effects)
    ]
    resists = declared.mass / spec.time_step**2
    for k, opinion in enumerate(opinions):
        if opinion.resists is not None:
            resists = resists + opinion.resists
        elif k in outside:
            resists = resists + resistance(bound[k].energies, n, spec.time_step)
    begins = [opinion.needs(resists) if opinion.needs else opinion.begin for opinion in opinions]
    return _Side(declared, opinions, begins, owned, outside)


def _known(effect: Any) -> bool:
    """Whether an effect is the shipped one of its kind."""
    kind = type(effect)
    return effect.kind in _OPINIONS and EFFECTS.get(effect.kind) == f"{kind.__module__}:{kind.__qualname__}"


def _opinion(effect: Any, empty: bool, declared: Declared) -> Opinion:
    return Opinion() if empty else _OPINIONS[effect.kind](effect, declared)


class _Answers:
    """Prepared: its solution of any step is one point."""

    choice, facts = "", {}  # noqa: RUF012  it is asked for neither

    def __init__(self, stated: Stated, shift: Array) -> None:
        m = stated.moment
        self.x = np.asarray(m.p + m.when * m.time_step * m.v, float) + shift

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        return Solution(self.x, 0, np.nan, np.nan, "iterations")


def _compared(sides: dict[Scene, _Side], scene: Scene, integrator: str, point: Point) -> Iterator[Finding]:
    """What differs at one point."""
    index = point.state.index
    of = scene.at(index)
    side, now, before = sides[of], point.state.now, point.state.before
    time = (index + 1) // 2 * sides[scene].declared.time_step
    time += index // 2 * (sides[of if index % 2 else scene.alternate or scene].declared.time_step)
    stated = state(integrator, side.declared, side.opinions, tuple(now), tuple(before) if before else None, time)
    answers: Any = _Answers(stated, point.shift)
    done = next(
        simulate(scene, answers, StopRule(), first_guess="current", frames=index + 1, state=point.state)
    )
    yield from _arrays(side, stated, done.problem, time)
    x, v = stated.after(answers.x)
    reach = _reach(stated, answers.x)
    yield from _differ("positions after the step", done.state.now.positions, x, reach)
    yield from _differ("velocities after the step", done.state.now.velocity, v, stated.moment.rate * reach)
    yield from _energies(side, stated, done.problem, answers.x, point.direction, reach)


def _reach(stated: Stated, x: Array) -> float:
    """The largest of the coordinates [m] that a step goes by."""
    m = stated.moment
    parts = (x, m.p, m.origin, m.time_step * m.v, stated.target)
    return max(float(np.abs(part).max(initial=0.0)) for part in parts)


def _differ(name: str, ours: Any, theirs: Any, size: float) -> Iterator[Finding]:
    """Arrays that differ by more than the round-off of numbers of a size."""
    ours, theirs = wide(ours), wide(theirs)
    if ours.shape != theirs.shape:
        yield Finding(f"{name} (number)", 1.0)
        return
    same = (ours == theirs) | (np.isnan(ours) & np.isnan(theirs))
    away = float(np.where(same, 0.0, np.abs(ours - theirs)).max(initial=0.0))
    if not away <= ROUNDINGS * EPS * size:
        yield Finding(name, away / max(float(np.abs(theirs).max(initial=0.0)), np.finfo(float).tiny))


def _arrays(side: _Side, stated: Stated, problem: StepProblem, time: float) -> Iterator[Finding]:
    """Masses, inertia, forces, pins."""
    system, declared, m = problem.system, side.declared, stated.moment
    dt, reach = m.time_step, _reach(stated, problem.target)
    most = float(np.abs(declared.mass).max(initial=0.0))
    yield from _differ("masses", system.mass, declared.mass, most)
    yield from _differ("inertia", system.inertia, stated.c * declared.mass / dt**2, stated.c * most / dt**2)
    yield from _differ("inertial target", problem.target, stated.target, reach)
    now = problem.start
    yield from _differ("the step's start", now.positions, m.p, reach)
    yield from _differ("filtered velocities", now.velocity, m.v, reach / dt)
    yield from _differ("origin of velocities", now.origin, m.origin, reach)
    yield from _differ("rate of velocities", [now.rate, system.rate], [m.rate, m.rate], m.rate)
    yield from _differ("times", [now.time, now.until], [m.time, m.until], max(m.until, dt))
    shortest = _shortest(side, Opinion())
    yield from _differ("forces", problem.force, stated.force, stated.force_size * (1.0 + reach / shortest))
    if problem.system.pins.vertices.tolist() != stated.vertices:
        yield Finding("pinned vertices", 1.0)
        return
    weights = [w for w in stated.weights if np.isfinite(w)]
    yield from _differ("weights of pins", system.pins.weight, stated.weights, max(weights, default=0.0))
    yield from _differ("targets of pins", problem.pin_targets, stated.held, _held(side, stated, reach))


def _held(side: _Side, stated: Stated, reach: float) -> float:
    """The size [m] of which eps is the round-off of the pins' targets."""
    size = reach + sum(opinion.reach for opinion in side.opinions)
    moves = [motion for effect in side.declared.effects if (motion := getattr(effect, "motion", None))]
    end = stated.moment.time + stated.moment.time_step
    return max([size, *(blur(motion, size, end) / EPS for motion in moves)])


def _shortest(side: _Side, opinion: Opinion) -> float:
    """The shortest length [m] that an effect goes by."""
    lengths = side.declared.mesh.rest_lengths
    return min(float(lengths[lengths > 0.0].min(initial=side.declared.mesh.spacing)), opinion.shortest)


def _energies(
    side: _Side, stated: Stated, problem: StepProblem, at: Array, along: Array, reach: float
) -> Iterator[Finding]:
    """Each effect's energies, and the objective."""
    x, d = wide(at), wide(along)
    d[[i for i, w in zip(stated.vertices, stated.weights, strict=True) if np.isinf(w)]] = 0
    value, slope, room = 0.0, 0.0, np.zeros(3)
    for k, begin in enumerate(side.begins):
        own = [problem.energies[i] for i in side.owned[k]]
        if not own and begin is None:
            continue
        if k in side.outside or begin is None:
            told, wrong = own_slope(own, at, np.asarray(d, float), reach, _shortest(side, Opinion()))
            if wrong is not None:
                yield Finding(f"{side.name(k)} (gradient against its own value)", wrong)
        else:
            opinion = side.opinions[k]
            motions = [getattr(one, "motion", None) for one in getattr(side.declared.effects[k], "obstacles", ())]
            motions.append(getattr(side.declared.effects[k], "motion", None))
            far = reach + opinion.reach
            far = max([far, *(blur(motion, far, stated.moment.until) / EPS for motion in motions)])
            told = tell(begin(stated.moment), x, d, far, _shortest(side, opinion))
            if np.isfinite(told.value) or any(np.isfinite(energy.value(at)) for energy in own):
                yield from _against(side.name(k), told, own, at, np.asarray(d, float))
        value, slope, room = value + told.value, slope + told.slope, room + np.array(told.allowed)
    yield from _objective(stated, problem, x, d, (value, slope, room), reach, _held(side, stated, reach))


def _against(name: str, told: Told, own: Sequence[Energy], x: Array, d: Array) -> Iterator[Finding]:
    """The energies of one effect against what is told of them."""
    gradient = np.zeros_like(x)
    for energy in own:
        energy.add_gradient(x, gradient)
    exact = len(x) <= _LARGEST_EXACT or "gas" not in name
    flat = d.ravel()
    bend = sum(float(flat @ (energy.hessian(x) @ flat)) for energy in own) if exact else told.bend
    figures = sum(energy.value(x) for energy in own), float((gradient * d).sum()), bend
    for what, ours, theirs, room in zip(("value", "gradient", "Hessian"), figures, told[:3], told.allowed, strict=True):
        if not abs(ours - theirs) <= room:
            yield Finding(f"{name} ({what})", abs(ours - theirs) / max(abs(theirs), np.finfo(float).tiny))


def _objective(
    stated: Stated,
    problem: StepProblem,
    x: Any,
    d: Any,
    energies: tuple[float, float, Any],
    reach: float,
    aimed: float,
) -> Iterator[Finding]:
    """The sum of all terms, and its gradient along d; aimed: the size [m] of the round-off of the pins' targets."""
    value, slope, room = energies
    if not np.isfinite(value):
        return
    soft = [i for i, w in enumerate(stated.weights) if np.isfinite(w)]
    held, weight = [stated.vertices[i] for i in soft], wide([stated.weights[i] for i in soft])
    inertia = wide(stated.c * problem.system.mass / stated.moment.time_step**2)

    def quadratic(y: Any) -> Any:
        away, sag = y - wide(stated.target), y[held] - stated.held[soft]
        terms = [inertia / 2 * (away**2).sum(axis=1), weight / 2 * (sag**2).sum(axis=1)]
        return np.concatenate([*terms, -(y * stated.force).sum(axis=1)])

    told = tell(quadratic, x, d, max(reach, aimed), reach or 1.0)
    at = np.asarray(x, float)
    size = float(np.abs(d).sum()) * stated.force_size
    figures = (
        ("value", problem.value(at), value + told.value, reach * size),
        ("gradient", float((problem.gradient(at) * np.asarray(d, float)).sum()), slope + told.slope, size),
    )
    for k, (what, ours, theirs, more) in enumerate(figures):
        if not abs(ours - theirs) <= room[k] + told.allowed[k] + ROUNDINGS * EPS * more:
            yield Finding(f"objective ({what})", abs(ours - theirs) / max(abs(theirs), np.finfo(float).tiny))
