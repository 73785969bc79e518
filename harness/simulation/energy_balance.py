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
ROUNDOFF_SAFETY times the work of sources, and the energy that the load gives to bodies at rest in one step. Pinned
vertices have no kinetic energy. Stored energy counts where a spring is strained by more than its length: stiff springs
that a solve leaves slightly too long store much energy, but move nothing. Exact lengths contribute the penalties of
their Lagrangian (`springbench.solvers.model.energies.augmented_lagrangian`). The round-off bound is subtracted from
a gain.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.recording.strain_shading import compute_strains
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, SimulationStep, build_initial_state, build_problem
from springbench.solvers.model.energies.augmented_lagrangian import (
    compute_penalty_stiffness,
    concatenate_constraints,
    length_errors,
)
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.rounding_bound import ROUNDOFF_FACTOR, gradient_roundoff
from springbench.solvers.model.step_problem import (
    Energy,
    Positions,
    ProjectiveEnergy,
    Solution,
    StepProblem,
    StopRule,
    is_lagged,
)
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix

GROWTH_LIMIT = 1.0
"""Ratio of gain to available energy above which energy has grown without a source. Converged steps of implicit Euler
gained nothing on the shipped scenes, 50 iterations of local-global at most 0.07. Midpoint gains 2 to 300,000 where its
step size is too large."""

ROUNDOFF_SAFETY = 10.0
"""Factor on the work of sources, which is estimated from the ends of steps. Motions faster than a step may receive more
work, or at another time. Dormand and Prince's method of order 8 gains 2.3 times the work of gusts taken as constant
within frames."""

BLOW_UP_FACTOR = 1e6
"""Ratio of gain to available energy above which a motion has diverged: it is a thousand times as fast as possible."""


class EnergyGain(NamedTuple):
    """Energy balance after a step: gain [J] that no source explains, and available energy [J]."""

    gain: float
    available_energy: float

    def is_above(self, ratio: float) -> bool:
        """Return whether the gain is NaN or more than a ratio of the available energy."""
        return not self.gain <= ratio * self.available_energy

    def __str__(self) -> str:
        return f"{self.gain:.2g} J more than its sources give, where {self.available_energy:.2g} J are available"

    @property
    def columns(self) -> dict[str, float]:
        """Columns of the balance in the rows of a frame."""
        return {"energy_gain": self.gain, "energy_available": self.available_energy}


class EnergyGrowth(NamedTuple):
    """Energy growth without a source.

    Attributes:
      first_frame: first frame after which energy has grown.
      max_ratio: largest ratio of gain to available energy.
    """

    first_frame: int
    max_ratio: float

    @classmethod
    def from_rows(cls, by_frame: Mapping[int, Mapping[str, Any]]) -> EnergyGrowth | None:
        """Build from a run's columns by frame; None where its energy has not grown."""
        return cls.from_balances(
            {frame: EnergyGain(row["energy_gain"], row["energy_available"]) for frame, row in by_frame.items()}
        )

    @classmethod
    def from_balances(cls, balances: Mapping[int, EnergyGain]) -> EnergyGrowth | None:
        """Build from the balances by frame; None where the energy has not grown."""
        grown = {frame: balance for frame, balance in balances.items() if balance.is_above(GROWTH_LIMIT)}
        if not grown:
            return None
        return cls(
            min(grown), max(b.gain / b.available_energy if b.available_energy else np.inf for b in grown.values())
        )

    def __str__(self) -> str:
        times = f"{self.max_ratio:,.0f}" if self.max_ratio >= 10.0 else f"{self.max_ratio:.1f}"
        return f"energy has grown {times} times without a source, from frame {self.first_frame} on"


class EnergyBalance:
    """Energy balance of one run, whose steps are added in order."""

    def __init__(self, scene: Scene) -> None:
        system = scene.system
        self._scene, self._now = scene, build_initial_state(scene).motion
        self._first = self._now.positions
        self._when = float(getattr(scene.integrator, "stage_fraction", 1.0))
        self._free, self._exact = system.free_vertices, system.pins.vertices[system.pins.exact_mask]
        self._mass, self._load = (
            np.where(system.unpinned_mask, system.mass, 0.0)[self._free],
            scene.constant_force[self._free],
        )
        self._lengths = concatenate_constraints(system.length_constraints)
        self._penalties = compute_penalty_stiffness(system, self._lengths)
        self._potentials = np.empty(0)
        self._at_start = self._given = self._released = self._sources = 0.0

    def add_step(self, step: SimulationStep) -> EnergyGain:
        """Return the balance after the next step."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._compute_gain(step)

    def _compute_gain(self, step: SimulationStep) -> EnergyGain:
        stated, x, p = step.problem, step.solution.positions, step.positions
        moved = p - self._now.positions
        if step.index == 1:
            self._set_initial_energy(stated, x, moved)
        before, after = self._potentials, self._potential_energies(stated, x, p, self._scene.compute_time(step.index))
        self._sources += self._source_work(step, before, after, moved)
        self._released = max(self._released, -float(np.minimum(after, 0.0).sum()))
        available = self._given + self._released + ROUNDOFF_SAFETY * self._sources
        speed = step.state.motion.velocity, moved / stated.system.time_step
        kinetic, stored = max(map(self._kinetic_energy, speed)), float(after.sum())
        low = float(np.minimum(np.minimum(before, after), 0.0).sum())
        if not stored <= GROWTH_LIMIT * available and not _compute_max_strain(self._scene, p) <= 1.0:
            low = stored
        self._potentials, self._now = after, step.state.motion
        gained = kinetic + low - self._at_start - self._sources
        if gained > GROWTH_LIMIT * available:
            gained -= _bound_roundoff(stated, x, step.index)
        return EnergyGain(gained, available)

    def _set_initial_energy(self, step_problem: StepProblem, x: Positions, moved: Positions) -> None:
        """Set the energy of the start.

        An energy may be infinite there, since its obstacle is already where it is at the step's end. It then starts
        with the value for which its work is zero.
        """
        potentials = self._potential_energies(step_problem, self._first, self._first, 0.0)
        for k, energy in enumerate(step_problem.energies):
            if not np.isfinite(potentials[k]):
                potentials[k] = energy.value(x) - self._directional_derivative(energy, x, moved)
        kinetic, load = self._kinetic_energy(self._now.velocity), np.einsum("ij,ij->i", self._load, self._load)
        in_one_step = np.divide(load, self._mass, out=np.zeros_like(load), where=self._mass > 0.0).sum()
        self._potentials, self._at_start = potentials, kinetic + float(potentials.sum())
        self._given = kinetic + float(np.abs(potentials).sum() + 0.5 * step_problem.system.time_step**2 * in_one_step)

    def _kinetic_energy(self, velocity: Positions) -> float:
        v = velocity[self._free]
        return 0.5 * float(self._mass @ np.einsum("ij,ij->i", v, v))

    def _potential_energies(
        self, step_problem: StepProblem, x: Positions, p: Positions, time: float
    ) -> NDArray[np.float64]:
        """Return the potentials [J] of energies, penalty pins, load and exact lengths.

        Evaluated for a step's solution x and end p, both (n, 3) [m], at a time [s].
        """
        soft, vertices, weight = step_problem.system.penalty_pins
        away = p[vertices] - self._scene.pin_targets_at(time)[soft]
        return np.array(
            [
                *(e.value(x if is_lagged(made) else p) for made, e in _pair_energies(step_problem)),
                0.5 * self._when * weight @ np.einsum("ij,ij->i", away, away),
                -_dot(self._load, (p - self._first)[self._free]),
                0.5 * self._penalties @ length_errors(self._lengths, p) ** 2,
            ]
        )

    def _source_work(
        self, step: SimulationStep, before: NDArray[np.float64], after: NDArray[np.float64], moved: Positions
    ) -> float:
        """Return the work [J] of sources in a step between potentials before and after it."""
        scene, stated, x, free = self._scene, step.problem, step.solution.positions, self._free
        work = list[float]()
        for k, (made, energy) in enumerate(_pair_energies(stated)):
            if is_lagged(made):
                work.append(after[k] - self._directional_derivative(energy, x, moved) - before[k])
        if scene.varying_forces:
            taken = [_dot((one.external_force - scene.constant_force)[free], moved[free]) for one, _ in step.stages]
            work.append(min(float(np.mean(taken)), self._force_work(step, moved)))
        if scene.velocity_filters:
            work.append(self._kinetic_energy(stated.step_start.velocity) - self._kinetic_energy(self._now.velocity))
        if scene.pin_motions:
            soft, vertices, weight = stated.system.penalty_pins
            led = scene.pin_targets_at(scene.compute_time(step.index)) - scene.pin_targets_at(
                scene.compute_time(step.index - 1)
            )
            work.append(_dot(weight[:, None] * (stated.pin_targets[soft] - x[vertices]), led[soft]))
            work[-1] = max(
                work[-1], _dot(self._conservative_gradient(stated, x)[vertices], led[soft])
            )  # where they are taken as exact
        if moved[self._exact].any():
            work.append(_dot(self._conservative_gradient(stated, x)[self._exact], moved[self._exact]))
            if len(self._penalties):  # tensions are what balances the gradient of all else
                work.append(_dot(stated.gradient(x), moved))
        return float(sum(max(0.0, one) for one in work))

    def _force_work(self, step: SimulationStep, moved: Positions) -> float:
        """Return the work [J] of changing forces at the mean velocity of a step.

        A drag evaluated at the start of a step, which reverses the motion, gives more. That is an effect of the method
        and not a source.
        """
        p, mean = self._now.positions, 0.5 * (self._now.velocity + step.state.motion.velocity)
        times = self._scene.compute_time(step.index - 1), self._scene.compute_time(step.index)
        return max(
            sum(_dot(force(p, mean, time)[self._free], moved[self._free]) for force in self._scene.varying_forces)
            for time in times
        )

    @staticmethod
    def _conservative_gradient(step_problem: StepProblem, x: Positions) -> Positions:
        """Return the gradient (n, 3) [N] at x of the energies without lag."""
        gradient = np.zeros_like(x)
        for made, energy in _pair_energies(step_problem):
            if not is_lagged(made):
                energy.add_gradient(x, gradient)
        return gradient

    def _directional_derivative(self, energy: Energy, x: Positions, moved: Positions) -> float:
        """Return grad e(x) . (p' - p) [J] over the free vertices."""
        gradient = np.zeros_like(x)
        energy.add_gradient(x, gradient)
        return _dot(gradient[self._free], moved[self._free])


def compute_frame_balances(scene: Scene, motions: Iterable[Motion]) -> Iterator[EnergyGain]:
    """Yield the balance after each frame of a motion, however it was integrated.

    Args:
      scene: the scene with the integrator `substepping`, whose time step is the frame.
      motions: motion after each frame.
    """
    balance, state = EnergyBalance(scene), build_initial_state(scene)
    for motion in motions:
        problem = build_problem(scene, state, "previous")
        solution = Solution(motion.positions, 1, np.nan, np.nan, "max-iter", motion.velocity)
        state = MotionState(motion, None, state.index + 1)
        step = SimulationStep(problem, solution, state, (1,), ((problem, solution),), StopRule(1))
        yield balance.add_step(step)


def _pair_energies(step_problem: StepProblem) -> zip[tuple[Energy, Energy]]:
    """Return pairs of each energy of the system and its state in the step problem."""
    return zip(step_problem.system.energies, step_problem.energies, strict=True)


def _dot(a: Positions, b: Positions) -> float:
    return float(np.einsum("ij,ij->", a, b))


def _compute_max_strain(scene: Scene, p: Positions) -> float:
    """Return the largest strain of the springs at p (n, 3) [m]."""
    return float(np.abs(compute_strains(p, scene.all_springs.edges, scene.all_springs.rest_length)[0]).max(initial=0.0))


def _bound_roundoff(step_problem: StepProblem, x: Positions, steps: int) -> float:
    """Return a bound on the accumulated round-off [J]; 0 where it overflows.

    In each step, (FACTOR delta_i)^2 / Q_ii is the energy of the round-off at vertex i.
    """
    free = step_problem.system.free_vertices
    Q = assemble_system_matrix(
        step_problem.system, [e for e in step_problem.system.energies if isinstance(e, ProjectiveEnergy)]
    )
    each = float(np.sum((ROUNDOFF_FACTOR * gradient_roundoff(step_problem, x)[free]) ** 2 / Q.diagonal()[free]))
    return steps**2 * each if np.isfinite(each) else 0.0
