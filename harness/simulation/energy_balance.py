"""The balance of energy of a motion: what it has after each step, and what its scene can have given it.

    gain = E_n - E_0 - work of sources,    E = kinetic energy + potentials - load . (p - p_0)

A motion of the scene keeps its energy or loses it: its gain is at most zero. Sources are forces that change, pins that
move, velocity filters, and energies that a step states anew, such as contact with moving obstacles. Their work in a
step counts where it is positive: what a scene dissipates hides no gain. With the step's unknown x it is

    f . (p' - p)                                          of forces, at the mean velocity of the step at most
    w (held - x) . (q' - q), grad U(x) . (q' - q)         of penalty and exact pins, whose targets move from q to q'
    e(x) - grad e(x) . (p' - p) - e_before(x_before)      of an energy e; not positive where it is convex and steady

A gain is measured by the energy that was available: that of the start, what potentials released, UNCERTAINTY times the
work of sources, and what the load gives to bodies at rest in one step. Pinned vertices have no kinetic energy. Energy
that is stored counts where a spring is strained by more than its length: stiff springs that a solve leaves a little too
long have much of it, and move nothing. Exact lengths count with the penalties of their Lagrangian
(`solvers.energies.augmented`). What round-off adds is no gain.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.record.shading import strains
from harness.scenes.bind import Scene
from harness.simulation.step import Step, start
from solvers.energies.augmented import joined, off, penalties
from solvers.matrices import assemble
from solvers.problem import Energy, Positions, ProjectiveEnergy, StepProblem, is_lagged
from solvers.round_off import FACTOR, gradient_round_off

GROWTH = 1.0
"""Gain over the available energy above which it has grown without a source. Converged steps of implicit Euler gained
nothing on the shipped scenes, 50 iterations of local-global 0.07 at most; midpoint gains 2 to 300,000 where its step is
too long."""

UNCERTAINTY = 10.0
"""On the work of sources, which is told from the ends of steps: what is faster than a step may take more, or give it
at another time. Dormand and Prince's method of order 8 gains 2.3 times the work of gusts that frames take as even."""

BLOW_UP = 1e6
"""Gain over the available energy from which on a motion has diverged: it is a thousand times as fast as it can be."""


class Balance(NamedTuple):
    """After a step: gained [J], what no source accounts for; available [J], what there was to move with."""

    gained: float
    available: float

    def exceeds(self, times: float) -> bool:
        """Whether the gain is more than `times` what was available, or not a number."""
        return not self.gained <= times * self.available

    def __str__(self) -> str:
        return f"{self.gained:.2g} J more than its sources give, where {self.available:.2g} J are available"


class Growth(NamedTuple):
    """first: the first frame after which energy has grown without a source; times: the largest gain over what was
    available."""

    first: int
    times: float

    @classmethod
    def of(cls, by_frame: Mapping[int, Mapping[str, Any]]) -> Growth | None:
        """Of a run's columns by frame; None where its energy has not grown."""
        balances = {frame: Balance(row["energy_gained"], row["energy_available"]) for frame, row in by_frame.items()}
        grown = {frame: balance for frame, balance in balances.items() if balance.exceeds(GROWTH)}
        if not grown:
            return None
        return cls(min(grown), max(b.gained / b.available if b.available else np.inf for b in grown.values()))


class EnergyBalance:
    """The balance of one run, whose steps are given in their order."""

    def __init__(self, scene: Scene) -> None:
        system = scene.system
        self._scene, self._now = scene, start(scene).now
        self._first = self._now.positions
        self._when = float(getattr(scene.integrator, "when", 1.0))
        self._free, self._exact = system.free, system.pins.vertices[system.pins.exact]
        self._mass, self._load = np.where(system.unpinned, system.mass, 0.0)[self._free], scene.load[self._free]
        self._lengths = joined(system.lengths)
        self._penalties = penalties(system, self._lengths)
        self._potentials = np.empty(0)
        self._at_start = self._given = self._released = self._sources = 0.0

    def after(self, step: Step) -> Balance:
        """The balance after the next step."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._after(step)

    def _after(self, step: Step) -> Balance:
        stated, x, p = step.problem, step.solution.positions, step.positions
        moved = p - self._now.positions
        if step.index == 1:
            self._begin(stated, x, moved)
        before, after = self._potentials, self._of_each(stated, x, p, self._scene.time(step.index))
        self._sources += self._work(step, before, after, moved)
        self._released = max(self._released, -float(np.minimum(after, 0.0).sum()))
        available = self._given + self._released + UNCERTAINTY * self._sources
        speed = step.state.now.velocity, moved / stated.system.time_step
        kinetic, stored = max(map(self._kinetic, speed)), float(after.sum())
        low = float(np.minimum(np.minimum(before, after), 0.0).sum())
        if not stored <= GROWTH * available and not _largest_strain(self._scene, p) <= 1.0:
            low = stored
        self._potentials, self._now = after, step.state.now
        gained = kinetic + low - self._at_start - self._sources
        if gained > GROWTH * available:
            gained -= _round_off(stated, x, step.index)
        return Balance(gained, available)

    def _begin(self, stated: StepProblem, x: Positions, moved: Positions) -> None:
        """Take the energy of the start. An energy that is infinite there, since its obstacle is where it will be at
        the step's end, begins with what makes no work of it."""
        potentials = self._of_each(stated, self._first, self._first, 0.0)
        for k, energy in enumerate(stated.energies):
            if not np.isfinite(potentials[k]):
                potentials[k] = energy.value(x) - self._along(energy, x, moved)
        kinetic, load = self._kinetic(self._now.velocity), np.einsum("ij,ij->i", self._load, self._load)
        in_one_step = np.divide(load, self._mass, out=np.zeros_like(load), where=self._mass > 0.0).sum()
        self._potentials, self._at_start = potentials, kinetic + float(potentials.sum())
        self._given = kinetic + float(np.abs(potentials).sum() + 0.5 * stated.system.time_step**2 * in_one_step)

    def _kinetic(self, velocity: Positions) -> float:
        v = velocity[self._free]
        return 0.5 * float(self._mass @ np.einsum("ij,ij->i", v, v))

    def _of_each(self, stated: StepProblem, x: Positions, p: Positions, time: float) -> NDArray[np.float64]:
        """The potentials [J] of the energies, of penalty pins, of the load and of exact lengths, for a step's unknown
        x and end p, both (n, 3) [m], at a time [s]."""
        soft, vertices, weight = stated.system.penalty
        away = p[vertices] - self._scene.pins_at(time)[soft]
        return np.array(
            [
                *(e.value(x if is_lagged(made) else p) for made, e in _pairs(stated)),
                0.5 * self._when * weight @ np.einsum("ij,ij->i", away, away),
                -_dot(self._load, (p - self._first)[self._free]),
                0.5 * self._penalties @ off(self._lengths, p) ** 2,
            ]
        )

    def _work(self, step: Step, before: NDArray[np.float64], after: NDArray[np.float64], moved: Positions) -> float:
        """The work [J] of sources in a step, between potentials before and after it."""
        scene, stated, x, free = self._scene, step.problem, step.solution.positions, self._free
        work = list[float]()
        for k, (made, energy) in enumerate(_pairs(stated)):
            if is_lagged(made):
                work.append(after[k] - self._along(energy, x, moved) - before[k])
        if scene.forces:
            taken = [_dot((one.force - scene.load)[free], moved[free]) for one, _ in step.stages]
            work.append(min(float(np.mean(taken)), self._work_of_forces(step, moved)))
        if scene.filters:
            work.append(self._kinetic(stated.start.velocity) - self._kinetic(self._now.velocity))
        if scene.moving:
            soft, vertices, weight = stated.system.penalty
            led = scene.pins_at(scene.time(step.index)) - scene.pins_at(scene.time(step.index - 1))
            work.append(_dot(weight[:, None] * (stated.pin_targets[soft] - x[vertices]), led[soft]))
            work[-1] = max(work[-1], _dot(self._pull(stated, x)[vertices], led[soft]))  # where they are taken as exact
        if moved[self._exact].any():
            work.append(_dot(self._pull(stated, x)[self._exact], moved[self._exact]))
            if len(self._penalties):  # tensions are what balances the gradient of all else
                work.append(_dot(stated.gradient(x), moved))
        return float(sum(max(0.0, one) for one in work))

    def _work_of_forces(self, step: Step, moved: Positions) -> float:
        """What forces that change give [J] at the mean velocity of a step. A drag that is taken where a step starts,
        and turns the motion around, gives more: that is the method's doing and no source."""
        p, mean = self._now.positions, 0.5 * (self._now.velocity + step.state.now.velocity)
        times = self._scene.time(step.index - 1), self._scene.time(step.index)
        return max(
            sum(_dot(force(p, mean, time)[self._free], moved[self._free]) for force in self._scene.forces)
            for time in times
        )

    @staticmethod
    def _pull(stated: StepProblem, x: Positions) -> Positions:
        """The gradient (n, 3) [N] at x of the energies that are the same in all steps."""
        gradient = np.zeros_like(x)
        for made, energy in _pairs(stated):
            if not is_lagged(made):
                energy.add_gradient(x, gradient)
        return gradient

    def _along(self, energy: Energy, x: Positions, moved: Positions) -> float:
        """grad e(x) . (p' - p) [J] over the vertices that are free."""
        gradient = np.zeros_like(x)
        energy.add_gradient(x, gradient)
        return _dot(gradient[self._free], moved[self._free])


def _pairs(stated: StepProblem) -> zip[tuple[Energy, Energy]]:
    """Each energy as the system has it and as the step states it."""
    return zip(stated.system.energies, stated.energies, strict=True)


def _dot(a: Positions, b: Positions) -> float:
    return float(np.einsum("ij,ij->", a, b))


def _largest_strain(scene: Scene, p: Positions) -> float:
    """Of springs at p (n, 3) [m]."""
    return float(np.abs(strains(p, scene.springs.edges, scene.springs.rest_length)[0]).max(initial=0.0))


def _round_off(stated: StepProblem, x: Positions, steps: int) -> float:
    """What the round-off of so many steps may add up to [J], 0 where it overflows: (FACTOR delta_i)^2 / Q_ii moves a
    vertex in each."""
    free = stated.system.free
    Q = assemble(stated.system, [e for e in stated.system.energies if isinstance(e, ProjectiveEnergy)])
    each = float(np.sum((FACTOR * gradient_round_off(stated, x)[free]) ** 2 / Q.diagonal()[free]))
    return steps**2 * each if np.isfinite(each) else 0.0
