"""Energy balance of a motion: its energy compared with that supplied by the scene.

    gain = E_n - E_0 - work of sources,    E = kinetic energy + potentials - load . (p - p_0)

The exact motion of the scene conserves or dissipates energy: its gain is at most zero. Sources are forces that change,
moving pins, velocity filters, and lagged energies, which change between steps, such as contact with moving obstacles.
Only positive work in a step counts, so that dissipation in the scene hides no gain. With the step's solution x the work
is

    f . (p' - p)                                          of forces, at the mean velocity of the step at most
    w (target - x) . (q' - q), grad U(x) . (q' - q)       of penalty and exact pins, whose targets move from q to q'
    e(x) - grad e(x) . (p' - p) - e_before(x_before)      of an energy e; not positive where it is convex and constant

A gain is measured relative to the available energy: that of the start, the energy released by potentials,
UNCERTAINTY times the work of sources, and the energy that the load gives to bodies at rest in one step. Pinned
vertices have no kinetic energy. Stored energy counts where a spring is strained by more than its length: stiff springs
that a solve leaves slightly too long store much energy, but move nothing. Exact lengths contribute the penalties of
their Lagrangian (`solvers.energies.augmented`). The round-off bound is subtracted from a gain.
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
"""Ratio of gain to available energy above which energy has grown without a source. Converged steps of implicit Euler
gained nothing on the shipped scenes, 50 iterations of local-global at most 0.07. Midpoint gains 2 to 300,000 where its
step size is too large."""

UNCERTAINTY = 10.0
"""Factor on the work of sources, which is estimated from the ends of steps. Motions faster than a step may receive more
work, or at another time. Dormand and Prince's method of order 8 gains 2.3 times the work of gusts taken as constant
within frames."""

BLOW_UP = 1e6
"""Ratio of gain to available energy above which a motion has diverged: it is a thousand times as fast as possible."""


class Balance(NamedTuple):
    """Energy balance after a step: gain [J] that no source explains, and available energy [J]."""

    gained: float
    available: float

    def exceeds(self, times: float) -> bool:
        """Return whether the gain is NaN or more than a ratio of the available energy."""
        return not self.gained <= times * self.available

    def __str__(self) -> str:
        return f"{self.gained:.2g} J more than its sources give, where {self.available:.2g} J are available"


class Growth(NamedTuple):
    """Energy growth without a source.

    Attributes:
      first: first frame after which energy has grown.
      times: largest ratio of gain to available energy.
    """

    first: int
    times: float

    @classmethod
    def of(cls, by_frame: Mapping[int, Mapping[str, Any]]) -> Growth | None:
        """Build from a run's columns by frame; None where its energy has not grown."""
        balances = {frame: Balance(row["energy_gained"], row["energy_available"]) for frame, row in by_frame.items()}
        grown = {frame: balance for frame, balance in balances.items() if balance.exceeds(GROWTH)}
        if not grown:
            return None
        return cls(min(grown), max(b.gained / b.available if b.available else np.inf for b in grown.values()))


class EnergyBalance:
    """Energy balance of one run, whose steps are added in order."""

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
        """Return the balance after the next step."""
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
        """Set the energy of the start.

        An energy may be infinite there, since its obstacle is already where it is at the step's end. It then starts
        with the value for which its work is zero.
        """
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
        """Return the potentials [J] of energies, penalty pins, load and exact lengths.

        Evaluated for a step's solution x and end p, both (n, 3) [m], at a time [s].
        """
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
        """Return the work [J] of sources in a step between potentials before and after it."""
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
        """Return the work [J] of changing forces at the mean velocity of a step.

        A drag evaluated at the start of a step, which reverses the motion, gives more. That is an effect of the method
        and not a source.
        """
        p, mean = self._now.positions, 0.5 * (self._now.velocity + step.state.now.velocity)
        times = self._scene.time(step.index - 1), self._scene.time(step.index)
        return max(
            sum(_dot(force(p, mean, time)[self._free], moved[self._free]) for force in self._scene.forces)
            for time in times
        )

    @staticmethod
    def _pull(stated: StepProblem, x: Positions) -> Positions:
        """Return the gradient (n, 3) [N] at x of the energies without lag."""
        gradient = np.zeros_like(x)
        for made, energy in _pairs(stated):
            if not is_lagged(made):
                energy.add_gradient(x, gradient)
        return gradient

    def _along(self, energy: Energy, x: Positions, moved: Positions) -> float:
        """Return grad e(x) . (p' - p) [J] over the free vertices."""
        gradient = np.zeros_like(x)
        energy.add_gradient(x, gradient)
        return _dot(gradient[self._free], moved[self._free])


def _pairs(stated: StepProblem) -> zip[tuple[Energy, Energy]]:
    """Return pairs of each energy of the system and its state in the step problem."""
    return zip(stated.system.energies, stated.energies, strict=True)


def _dot(a: Positions, b: Positions) -> float:
    return float(np.einsum("ij,ij->", a, b))


def _largest_strain(scene: Scene, p: Positions) -> float:
    """Return the largest strain of the springs at p (n, 3) [m]."""
    return float(np.abs(strains(p, scene.springs.edges, scene.springs.rest_length)[0]).max(initial=0.0))


def _round_off(stated: StepProblem, x: Positions, steps: int) -> float:
    """Return a bound on the accumulated round-off [J]; 0 where it overflows.

    In each step, (FACTOR delta_i)^2 / Q_ii is the energy of the round-off at vertex i.
    """
    free = stated.system.free
    Q = assemble(stated.system, [e for e in stated.system.energies if isinstance(e, ProjectiveEnergy)])
    each = float(np.sum((FACTOR * gradient_round_off(stated, x)[free]) ** 2 / Q.diagonal()[free]))
    return steps**2 * each if np.isfinite(each) else 0.0
