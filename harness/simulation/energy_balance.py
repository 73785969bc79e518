"""Energy of a motion: its growth without a source, and the losses of each step.

The gain of a motion is compared with the energy that the scene supplies:

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

A step with stages x_i, velocities v_i and weights b_i balances the work of all forces, of the residual too:

    kinetic energy + potentials after the step - those before it
        = work of sources - dissipation by (damping + friction + integrator + unconverged solves)

    damping       dt sum_i b_i grad e(x_i) . v_i of damping energies, and kinetic energy that velocity filters remove
    friction      the same of friction's potential, at the velocity relative to the obstacle
    solve         -dt sum_i b_i r(x_i) . v_i, r the gradient of the step's objective, which is zero at its minimum
    integrator    dt sum_i b_i M a_i . v_i - change of the kinetic energy
                  + dt sum_i b_i grad U(x_i) . v_i - change of the potentials U

a_i = c/dt^2 (x_i - target) is the acceleration of a stage. Implicit Euler has one stage, its end, and dissipates
1/2 |v' - v|_M^2 + U(p) - U(p') - grad U(p') . (p - p'), which is positive where U is convex. The residual acts like a
force that the scene does not have: where a solve ends early, it may supply energy as well as dissipate it. The
tensions of length constraints are the part of the residual in the span of the constraints' gradients; they do no work
in the exact motion. Sources are changing forces, moving pins and obstacles, and energies whose parameters change. The
work of the latter is the mean of that at the two ends of a step. Exactly pinned vertices have no kinetic energy.

A start may have pinned vertices away from their targets. The constraint projects them, which is not part of the
motion: the energy of the start is that after the projection. Midpoint has its stage while the pins are still moving,
and solvers of frames move them uniformly; the work of that motion is then a source. Penalty pins that reach their
targets in this first step act as exact ones during the run: the kinetic energy of their vertices, which may ring, is
work of the pins.

The terms are evaluated separately, so their sum tests them: it differs from the change of the energy by round-off.

A solver that integrates frames itself gives motions at their ends only. Potentials are known there, and loads that it
takes as constant do the work f . (p' - p). The work of damping energies and of moving pins is integrated by Boole's
rule along cubic Hermite polynomials; its difference from Simpson's rule estimates the error. The rest is what the
integrator dissipated or, where the solver iterates within frames, the integrator and the solves together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from functools import reduce
from math import ceil
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.spring_strains import compute_strains
from springbench.harness.simulation.adaptive_stepping import interpolate_hermite
from springbench.harness.simulation.step_stages import StageSequence
from springbench.harness.simulation.time_loop import (
    MotionState,
    SimulationStep,
    build_initial_state,
    build_integrated_step,
    build_problem,
)
from springbench.solvers.contact.contact_work import ContactEnergy
from springbench.solvers.model.energies.augmented_lagrangian import (
    compute_penalty_stiffness,
    concatenate_constraints,
    length_errors,
)
from springbench.solvers.model.integrators import Motion, RungeKutta, SingleStageIntegrator
from springbench.solvers.model.rounding_bound import ROUNDOFF_FACTOR, gradient_roundoff
from springbench.solvers.model.step_problem import (
    Energy,
    Positions,
    ProjectiveEnergy,
    StepProblem,
    StepStart,
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
"""Ratio of gain to available energy above which a motion has diverged, at a thousand times the possible speed."""

_ACTIVE_LENGTH_RTOL = 1e-6
"""Distance from a bound, relative to it, within which a length is taken to be constrained: solves satisfy lengths to
1e-9 and better."""

_PLACED_RTOL = 1e-2
"""Distance from their targets after the first step, relative to that before it, within which pins have been placed."""

_REGULARISATION, _NUM_REFINEMENTS = 1e-10, 4
"""Shift of the matrix of the tensions, and number of the refinements that remove its effect.

The diagonal of the matrix is 2, and redundant constraints make it singular. Each refinement reduces the effect of the
shift by the factor shift/eigenvalue."""


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


class _StepAccount:
    """Data of both balances of a run: scene, motion so far, and latest potentials."""

    def __init__(self, scene: Scene, mass: NDArray[np.float64]) -> None:
        """Start at the scene's start.

        Args:
            scene: scene that is stepped.
            mass: masses (n,) [kg] for the kinetic energy; those of exactly pinned vertices do not count.
        """
        system = scene.system
        self._scene, self._motion = scene, build_initial_state(scene).motion
        self._first = self._motion.positions
        self._when = float(getattr(scene.integrator, "stage_fraction", 1.0))
        self._free, self._exact = system.free_vertices, system.pins.vertices[system.pins.exact_mask]
        self._mass, self._load = mass[self._free], scene.constant_force[self._free]
        self._lengths = concatenate_constraints(system.length_constraints)
        self._potentials = np.empty(0)
        self._released = 0.0

    def _kinetic_energy(self, velocity: Positions) -> float:
        return compute_kinetic_energy(self._mass, velocity[self._free])

    def _pin_and_load_energies(self, step_problem: StepProblem, p: Positions, time: float) -> tuple[float, float]:
        """Return the potentials [J] of penalty pins and of the load at p (n, 3) [m] and a time [s]."""
        soft, vertices, weight = step_problem.system.penalty_pins
        away = p[vertices] - self._scene.compute_pin_targets(time)[soft]
        return (
            0.5 * self._when * float(weight @ np.einsum("ij,ij->i", away, away)),
            -_dot(self._load, (p - self._first)[self._free]),
        )

    def _update_released(self, potentials: NDArray[np.float64]) -> float:
        """Return the largest energy [J] that potentials have released so far."""
        self._released = max(self._released, -float(np.minimum(potentials, 0.0).sum()))
        return self._released


class EnergyBalance(_StepAccount):
    """Energy balance of one run, whose steps are added in order."""

    def __init__(self, scene: Scene) -> None:
        system = scene.system
        super().__init__(scene, np.where(system.unpinned_mask, system.mass, 0.0))
        self._penalties = compute_penalty_stiffness(system, self._lengths)
        self._at_start = self._given = self._sources = 0.0

    def add_step(self, step: SimulationStep) -> EnergyGain:
        """Return the balance after the next step."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._compute_gain(step)

    def _compute_gain(self, step: SimulationStep) -> EnergyGain:
        stated, x, p = step.problem, step.solution.positions, step.positions
        moved = p - self._motion.positions
        if step.index == 1:
            self._set_initial_energy(stated, x, moved)
        before, after = self._potentials, self._potential_energies(stated, x, p, self._scene.compute_time(step.index))
        self._sources += self._source_work(step, before, after, moved)
        available = self._given + self._update_released(after) + ROUNDOFF_SAFETY * self._sources
        speed = step.state.motion.velocity, moved / stated.system.time_step
        kinetic, stored = max(map(self._kinetic_energy, speed)), float(after.sum())
        low = float(np.minimum(np.minimum(before, after), 0.0).sum())
        if not stored <= GROWTH_LIMIT * available and not _compute_max_strain(self._scene, p) <= 1.0:
            low = stored
        self._potentials, self._motion = after, step.state.motion
        gained = kinetic + low - self._at_start - self._sources
        if gained > GROWTH_LIMIT * available:
            gained -= _bound_roundoff(stated, x, step.index)
        return EnergyGain(gained, available)

    def _set_initial_energy(self, step_problem: StepProblem, x: Positions, moved: Positions) -> None:
        """Set the energy of the start.

        An energy may be infinite there, because its obstacle is already at its place at the end of the step. Its
        initial value is then the one for which its work is zero.
        """
        potentials = self._potential_energies(step_problem, self._first, self._first, 0.0)
        for k, energy in enumerate(step_problem.energies):
            if not np.isfinite(potentials[k]):
                potentials[k] = energy.value(x) - self._directional_derivative(energy, x, moved)
        kinetic, load = self._kinetic_energy(self._motion.velocity), np.einsum("ij,ij->i", self._load, self._load)
        in_one_step = np.divide(load, self._mass, out=np.zeros_like(load), where=self._mass > 0.0).sum()
        self._potentials, self._at_start = potentials, kinetic + float(potentials.sum())
        self._given = kinetic + float(np.abs(potentials).sum() + 0.5 * step_problem.system.time_step**2 * in_one_step)

    def _potential_energies(
        self, step_problem: StepProblem, x: Positions, p: Positions, time: float
    ) -> NDArray[np.float64]:
        """Return the potentials [J] of energies, penalty pins, load and exact lengths.

        Evaluated for a step's solution x and end p, both (n, 3) [m], at a time [s].
        """
        return np.array(
            [
                *(e.value(x if is_lagged(made) else p) for made, e in _pair_energies(step_problem)),
                *self._pin_and_load_energies(step_problem, p, time),
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
            work.append(self._kinetic_energy(stated.step_start.velocity) - self._kinetic_energy(self._motion.velocity))
        if scene.pin_motions:
            soft, vertices, weight = stated.system.penalty_pins
            led = scene.compute_pin_targets(scene.compute_time(step.index)) - scene.compute_pin_targets(
                scene.compute_time(step.index - 1)
            )
            work.append(_dot(weight[:, None] * (stated.pin_targets[soft] - x[vertices]), led[soft]))
            work[-1] = max(
                work[-1], _dot(self._conservative_gradient(stated, x)[vertices], led[soft])
            )  # the work if penalty pins act as exact ones
        if moved[self._exact].any():
            work.append(_dot(self._conservative_gradient(stated, x)[self._exact], moved[self._exact]))
            if len(self._penalties):  # tensions balance the gradient of all other terms
                work.append(_dot(stated.gradient(x), moved))
        return float(sum(max(0.0, one) for one in work))

    def _force_work(self, step: SimulationStep, moved: Positions) -> float:
        """Return the work [J] of changing forces at the mean velocity of a step.

        A drag evaluated at the start of a step, which reverses the motion, gives more. That is an effect of the method
        and not a source.
        """
        p, mean = self._motion.positions, 0.5 * (self._motion.velocity + step.state.motion.velocity)
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


_NUM_STATES = 3
"""Number of the first fields of StepDissipation, which are states; the others are summed over steps."""

_QUADRATURE_NODES = (0.0, 0.25, 0.5, 0.75, 1.0)
_BOOLE_WEIGHTS = (7 / 90, 32 / 90, 12 / 90, 32 / 90, 7 / 90)
_SIMPSON_WEIGHTS = (1 / 6, 0.0, 4 / 6, 0.0, 1 / 6)
"""Nodes within a frame as fractions of it, and the weights of both rules."""


class StepDissipation(NamedTuple):
    """Energies after a step and its dissipation by cause, each [J].

    A value is None where its cause cannot be separated.

    Attributes:
        kinetic_energy: of all vertices without an exact pin.
        potential_energy: springs, loads, penalty pins and all other potentials; loads relative to the start.
        provided_energy: energy of the start, released by loads, and positive work of sources, up to this step.
        source_work: work of sources in the step.
        dissipation_damping, dissipation_friction, dissipation_integrator, dissipation_solve: in the step.
        dissipation_engine: by integrator and solves together, where a solver iterates within the frames it integrates.
        balance_error: change of the energy in the step that these terms do not explain; of frames that the solver
            integrated, the error of the work by quadrature.
    """

    kinetic_energy: float
    potential_energy: float | None = None
    provided_energy: float | None = None
    source_work: float | None = None
    dissipation_damping: float | None = None
    dissipation_friction: float | None = None
    dissipation_integrator: float | None = None
    dissipation_solve: float | None = None
    dissipation_engine: float | None = None
    balance_error: float | None = None

    @property
    def columns(self) -> dict[str, Any]:
        """Columns in the rows of a frame; a value that overflows is None."""
        return {k: value if value is None or np.isfinite(value) else None for k, value in self._asdict().items()}

    @property
    def dissipated_energy(self) -> float:
        """Energy [J] dissipated by all known causes."""
        return sum(value or 0.0 for name, value in self._asdict().items() if name.startswith("dissipation_"))

    def add_step(self, later: StepDissipation) -> StepDissipation:
        """Return the dissipation of this step and the next one together."""
        works = zip(self[_NUM_STATES:], later[_NUM_STATES:], strict=True)
        return StepDissipation(*later[:_NUM_STATES], *(None if b is None else (a or 0.0) + b for a, b in works))

    def at_rest(self) -> StepDissipation:
        """Return the same energies without dissipation."""
        return StepDissipation(*self[:_NUM_STATES], *(None if a is None else 0.0 for a in self[_NUM_STATES:]))


class _StagePower(NamedTuple):
    """Power [W] of each kind of force at a stage; multiplied by a time, its work [J]."""

    inertia: float = 0.0
    potentials: float = 0.0
    damping: float = 0.0
    friction: float = 0.0
    sources: float = 0.0
    residual: float = 0.0
    tensions: float = 0.0

    def add_scaled(self, factor: float, other: _StagePower) -> _StagePower:
        """Return self + factor * other."""
        return _StagePower(*(a + factor * b for a, b in zip(self, other, strict=True)))


class DissipationBudget(_StepAccount):
    """Dissipation of one run, whose steps are added in order."""

    def __init__(self, scene: Scene, *, has_inner_solves: bool = False) -> None:
        """Start at the scene's start.

        Args:
            scene: scene that is stepped.
            has_inner_solves: whether a solver iterates within the frames that it integrates itself.
        """
        super().__init__(scene, scene.system.mass)
        self._kinetic = self._kinetic_energy(self._motion.velocity)
        self._has_inner_solves, self._time = has_inner_solves, 0.0
        self._begun: tuple[Energy, ...] = ()
        self._provided = 0.0
        self._last_power = _StagePower()
        self._pin_positions, self._is_projected, self._are_pins_driven = np.empty((0, 3)), False, False
        self._dynamic = self._free

    def add_step(self, step: SimulationStep, end_time: float | None = None) -> StepDissipation:
        """Return the dissipation of the next step.

        Args:
            step: completed step; steps are added in order.
            end_time: time [s] at which it ends; that of its index if omitted.
        """
        end = self._scene.compute_time(step.index) if end_time is None else end_time
        if step.index == 1:
            self._place_start(step, end)
        with np.errstate(over="ignore", invalid="ignore"):
            found = self._add_stages(step, end) if step.solution.velocity is None else self._add_integrated(step, end)
        self._motion, self._kinetic, self._time = step.state.motion, found.kinetic_energy, end
        self._is_projected, self._pin_positions = False, self._scene.compute_pin_targets(end)
        return found

    def _place_start(self, step: SimulationStep, end: float) -> None:
        """Set the pin positions from which the first step moves the pins.

        The step ends at the time `end` [s].
        """
        system, targets = self._scene.system, self._scene.compute_pin_targets(0.0)
        pinned, (soft, vertices, _) = system.pins.vertices, system.penalty_pins
        away = targets - self._first[pinned]
        left = self._scene.compute_pin_targets(end)[soft] - step.positions[vertices]
        placed = float(np.linalg.norm(left)) <= _PLACED_RTOL * float(np.linalg.norm(away[soft]))
        self._are_pins_driven = bool(away[soft].any()) and placed
        self._dynamic = np.setdiff1d(self._free, vertices) if self._are_pins_driven else self._free
        led = system.pins.exact_mask | self._are_pins_driven
        is_way_simulated = self._when < 1.0 or step.solution.velocity is not None
        self._pin_positions = np.where((led & is_way_simulated)[:, None], self._first[pinned], targets)
        if not is_way_simulated and away[led].any():
            self._is_projected, self._first = True, self._first.copy()
            self._first[pinned[led]] = targets[led]
            self._motion = self._motion._replace(positions=self._first)

    def _add_stages(self, step: SimulationStep, end: float) -> StepDissipation:
        """Add a step of an integrator, which ends at a time [s]."""
        problem, moved = step.problem, self._scene.compute_pin_targets(end) - self._pin_positions
        work = self._sum_work(step, moved)
        before, after, driven = self._update_potentials(step, step.solution.positions, end)
        kinetic = self._kinetic_energy(step.state.motion.velocity)
        filtered = self._kinetic_energy(problem.step_start.velocity)
        removed = self._kinetic - filtered
        ringing = 0.0
        if self._are_pins_driven:
            ringing = self._gain_of_pins(problem, step.state.motion.velocity) + float(after[-2] - before[-2])
            driven += ringing
        sources = work.sources + driven - min(0.0, removed)
        changed = float((after - before).sum())
        found = StepDissipation(
            kinetic_energy=kinetic,
            potential_energy=float(after.sum()),
            source_work=sources,
            dissipation_damping=work.damping + max(0.0, removed),
            dissipation_friction=work.friction,
            dissipation_integrator=work.inertia - (kinetic - filtered) + work.potentials - (changed - driven)
            - work.tensions,
            dissipation_solve=-work.residual,
        )  # fmt: skip
        error = kinetic - self._kinetic + changed - (sources - found.dissipated_energy)
        return found._replace(provided_energy=self._update_provided(sources - ringing), balance_error=error)

    @staticmethod
    def _gain_of_pins(problem: StepProblem, velocity: Positions) -> float:
        """Return the kinetic energy [J] that the vertices of penalty pins gain up to velocities (n, 3) [m/s]."""
        soft = problem.system.penalty_pins[1]
        before, after = (
            compute_kinetic_energy(problem.system.mass[soft], v[soft]) for v in (problem.step_start.velocity, velocity)
        )
        return after - before

    def _update_potentials(
        self, step: SimulationStep, x: Positions, end: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Return potentials before and after a step [J], and the work [J] of changing parameters in it.

        x (n, 3) [m] is the last stage.
        """
        problem, p = step.problem, step.positions
        after = self._evaluate_potentials(problem, x, p, end)
        if step.index == 1:
            at_start = self._evaluate_potentials(problem, self._first, self._first, 0.0)
            self._set_start(np.where(np.isfinite(at_start), at_start, after))
            self._begun = problem.energies
        before, driven = self._potentials, self._parameter_work(problem, after, self._motion.positions, p)
        self._potentials, self._begun = after, problem.energies
        return before, after, driven

    def _add_integrated(self, step: SimulationStep, end: float) -> StepDissipation:
        """Add a step that the solver integrated itself."""
        problem, v = step.problem, step.state.motion.velocity
        pinned = problem.system.pins.vertices
        led = step.positions[pinned] - self._motion.positions[pinned]
        kinetic = self._kinetic_energy(v)
        unknown = any(isinstance(energy, ContactEnergy) for energy in problem.energies)
        if unknown or (led.any() and self._scene.system.length_constraints):
            return StepDissipation(kinetic)
        before, after, driven = self._update_potentials(step, step.positions, end)
        works = self._integrate_work(step, led)
        work, error = works[0], abs(works[0].damping - works[1].damping) + abs(works[0].sources - works[1].sources)
        filtered = self._kinetic_energy(problem.step_start.velocity)
        removed = self._kinetic - filtered
        sources = work.sources + driven - min(0.0, removed)
        if led.any():  # penalty pins also move the mass of their vertices, and store energy
            sources += self._gain_of_pins(problem, v) + float(after[-2] - before[-2])
        damping = work.damping + max(0.0, removed)
        lost = self._kinetic - kinetic - float((after - before).sum()) + sources - damping
        own = (None, None, lost) if self._has_inner_solves else (lost, None, None)
        return StepDissipation(
            kinetic, float(after.sum()), self._update_provided(sources), sources, damping, 0.0, *own, error
        )

    def _integrate_work(self, step: SimulationStep, led: Positions) -> tuple[_StagePower, _StagePower]:
        """Return the work [J] in a frame by Boole's and by Simpson's rule.

        Pinned vertices move by `led` [m].
        """
        problem, system, start = step.problem, step.problem.system, step.problem.step_start
        dt, pinned, rate = system.time_step, system.pins.vertices, system.velocity_rate
        power = list[_StagePower]()
        for part in _QUADRATURE_NODES:
            p, v = interpolate_hermite(Motion(self._motion.positions, start.velocity), step.state.motion, dt, part)
            p, v = p.copy(), v.copy()
            p[pinned], v[pinned] = step.positions[pinned] - (1.0 - part) * led, led / dt
            time = start.time + part * dt
            here = StepStart(p, v, time, p - v / rate, rate, time)
            at_node = StepProblem(system, p, problem.external_force, p[pinned], p, p, here)
            power.append(self._stage_power(at_node, p, np.zeros_like(led), start))
        found = list[_StagePower]()
        for weights in (_BOOLE_WEIGHTS, _SIMPSON_WEIGHTS):
            work = _StagePower()
            for weight, one in zip(weights, power, strict=True):
                work = work.add_scaled(dt * weight, one)
            found.append(work)
        return found[0], found[1]

    def _sum_work(self, step: SimulationStep, moved: Positions) -> _StagePower:
        """Return the work [J] of each kind of force in a step.

        Pin targets are displaced by `moved` [m] in the step.
        """
        method, dt = self._scene.integrator, step.problem.system.time_step
        count, work = len(step.stages), _StagePower()
        weights = method.a[-1][-count:] if isinstance(method, RungeKutta) else (1.0 / count,) * count
        if isinstance(method, RungeKutta) and method.needs_start_acceleration:  # its first stage is the start
            power = self._start_power(step) if step.index == 1 else self._last_power
            work = work.add_scaled(dt * method.a[-1][0], power)
        for weight, (problem, solution) in zip(weights, step.stages, strict=True):
            self._last_power = self._stage_power(problem, solution.positions, moved / dt)
            work = work.add_scaled(dt * weight, self._last_power)
        return work

    def _start_power(self, step: SimulationStep) -> _StagePower:
        """Return the power at the start of the run.

        The acceleration at the start is that of all forces.
        """
        start = step.problem.step_start
        scene = self._scene.find_step_scene(0)
        stages = StageSequence(scene, self._motion._replace(velocity=start.velocity), None, start.time)
        power = self._stage_power(stages.build_start_problem(), self._first, scene.compute_pin_velocities(0.0))
        return power._replace(inertia=-power.residual, residual=0.0)

    def _stage_power(
        self, problem: StepProblem, x: Positions, pin_velocity: Positions, frame: StepStart | None = None
    ) -> _StagePower:
        """Return the power at a stage x (n, 3) [m], with pin targets at a velocity (q, 3) [m/s].

        With the start of a frame, forces that change are those of that start, and penalty pins act as exact ones.
        """
        system, start, free, exact = problem.system, problem.step_start, self._free, self._exact
        soft, vertices, weight = system.penalty_pins
        v, total = start.velocity_at(x), np.zeros_like(x)
        if self._is_projected and isinstance(self._scene.integrator, SingleStageIntegrator) and not frame:
            v[exact] = pin_velocity[~soft]
        if self._are_pins_driven and not frame:
            v[vertices] = pin_velocity[soft]
        potentials = damping = friction = sources = 0.0
        for energy in problem.energies:
            gradient = np.zeros_like(x)
            energy.add_gradient(x, gradient)
            total += gradient
            power = _dot(gradient, v)
            if getattr(energy, "is_dissipative", False):
                damping += power
                continue
            if isinstance(energy, ContactEnergy):
                dragged, lasts = energy.friction_gradient(x), start.stage_time - start.time
                normal, tangential = (work / lasts for work in energy.obstacle_work(x, start.positions))
                rubbed = 0.0 if dragged is None else _dot(dragged, v)
                friction += rubbed + tangential
                sources += normal + tangential
                power += normal - rubbed
            potentials += power
        potentials -= _dot(self._load, v[free])
        if not self._are_pins_driven:
            pull = weight[:, None] * (x[vertices] - problem.pin_targets[soft])
            potentials += _dot(pull, v[vertices] - pin_velocity[soft])
            sources -= _dot(pull, pin_velocity[soft])
        sources += _dot((problem.external_force - self._scene.constant_force)[free], v[free])
        for force in self._scene.varying_forces:
            if getattr(force, "is_dissipative", False):
                at = (frame.positions, frame.velocity, frame.time) if frame else (x, v, start.stage_time)
                lost = -_dot(force(*at)[free], v[free])
                damping, sources = damping + lost, sources + lost
        residual = problem.gradient(x)
        tension = self._find_tensions(x, residual)
        sources += _dot((total - tension)[exact], v[exact])
        if frame or self._are_pins_driven:
            sources += _dot((total - problem.external_force - tension)[vertices], v[vertices])
        dynamic = self._dynamic
        inertia = system.inertia_diagonal[dynamic, None] * (x - problem.inertial_target)[dynamic]
        return _StagePower(
            _dot(inertia, v[dynamic]),
            potentials,
            damping,
            friction,
            sources,
            _dot((residual - tension)[dynamic], v[dynamic]),
            _dot(tension, v),
        )

    def _find_tensions(self, x: Positions, residual: Positions) -> Positions:
        """Return the part of a residual (n, 3) [N] that tensions of active length constraints balance at x."""
        if not len(self._lengths.edges):
            return np.zeros_like(x)
        i, j = self._lengths.edges.T
        length = np.linalg.norm(x[i] - x[j], axis=1)
        low, high = self._lengths.min_length, self._lengths.max_length
        active = (length >= (1.0 - _ACTIVE_LENGTH_RTOL) * high) | (length <= (1.0 + _ACTIVE_LENGTH_RTOL) * low)
        active &= length > 0.0
        if not active.any():
            return np.zeros_like(x)
        i, j, count = i[active], j[active], int(active.sum())
        direction = (x[i] - x[j]) / length[active, None]
        rows = np.repeat(np.arange(count), 6)
        columns = np.stack([*(3 * i + k for k in range(3)), *(3 * j + k for k in range(3))], axis=1).ravel()
        entries = np.concatenate([direction, -direction], axis=1).ravel()
        gradients = scipy.sparse.csr_array((entries, (rows, columns)), shape=(count, x.size))
        free = (3 * self._free[:, None] + np.arange(3)).ravel()
        of_free, expected = gradients[:, free], residual[self._free].ravel()
        normal = of_free @ of_free.T + scipy.sparse.diags_array(np.full(count, _REGULARISATION))
        factor, tensions = splu(scipy.sparse.csc_array(normal)), np.zeros(count)
        for _ in range(_NUM_REFINEMENTS):
            tensions += factor.solve(of_free @ (expected - of_free.T @ tensions))
        return (gradients.T @ tensions).reshape(x.shape)

    def _parameter_work(
        self, problem: StepProblem, after: NDArray[np.float64], before: Positions, p: Positions
    ) -> float:
        """Return the work [J] of changing energy parameters in a step from positions `before` to p.

        It is the mean of the change at the two ends, so that it is that of the mean force.
        """
        work = 0.0
        for k, (made, energy, earlier) in enumerate(
            zip(problem.system.energies, problem.energies, self._begun, strict=True)
        ):
            if _is_driven(made):
                ends = energy.value(before) - self._potentials[k], after[k] - earlier.value(p)
                work += 0.5 * sum(ends) if np.isfinite(ends).all() else float(after[k] - self._potentials[k])
        return work

    def _evaluate_potentials(
        self, problem: StepProblem, x: Positions, p: Positions, time: float
    ) -> NDArray[np.float64]:
        """Return the potentials [J] of each energy, of penalty pins and of the load.

        Contact is evaluated at the stage x, all else at p, both (n, 3) [m], at a time [s].
        """
        return np.array(
            [
                *(_stored_energy(energy, x, p) for energy in problem.energies),
                *self._pin_and_load_energies(problem, p, time),
            ]
        )

    def _set_start(self, potentials: NDArray[np.float64]) -> None:
        """Set the potentials of the start.

        Penalty pins that act as exact ones store no energy at the start.
        """
        if self._are_pins_driven:
            potentials[-2] = 0.0
        self._potentials = potentials
        self._provided = self._kinetic + float(np.maximum(potentials, 0.0).sum())

    def _update_provided(self, sources: float) -> float:
        """Return the energy [J] provided so far, after a step with a work of sources."""
        self._provided += max(0.0, sources)
        return self._provided + self._update_released(self._potentials)


class FrameDissipation:
    """Dissipation of a motion by frames, from steps whose lengths may differ from a frame.

    A step belongs to the frame in which it ends. A frame in which none ends has the energies of the one before it.

    Attributes:
        by_frame: dissipation of each frame, from 1.
    """

    def __init__(self, frame_seconds: float) -> None:
        """Set the length of a frame [s]."""
        self._frame_seconds, self._budget = frame_seconds, None
        self.by_frame = dict[int, StepDissipation]()

    def add_step(self, scene: Scene, step: SimulationStep, end_time: float) -> None:
        """Add the dissipation of the next step to that of its frame.

        Args:
            scene: scene of the step; the scenes of all steps differ in the step size only.
            step: completed step.
            end_time: time [s] at which it ends.
        """
        self._budget = self._budget or DissipationBudget(scene)
        found, frame = self._budget.add_step(step, end_time), ceil(end_time / self._frame_seconds - 1e-6)
        last = max(self.by_frame, default=0)
        for empty in range(last + 1, frame):
            self.by_frame[empty] = self.by_frame[last].at_rest()
        before = self.by_frame.get(frame)
        self.by_frame[frame] = before.add_step(found) if before else found


def sum_dissipation(by_frame: Mapping[int, StepDissipation]) -> StepDissipation:
    """Sum the dissipation of all frames; energies are those of the last frame.

    There must be at least one frame.
    """
    return reduce(StepDissipation.add_step, (by_frame[frame] for frame in sorted(by_frame)))


def compute_kinetic_energy(mass: NDArray[np.float64], velocity: Positions) -> float:
    """Compute the kinetic energy 1/2 v' M v [J].

    Args:
        mass: vertex masses (n,) [kg].
        velocity: velocities (n, 3) [m/s].
    """
    return 0.5 * float(mass @ np.einsum("ij,ij->i", velocity, velocity))


def compute_frame_balances(scene: Scene, motions: Iterable[Motion]) -> Iterator[EnergyGain]:
    """Yield the balance after each frame of a motion, however it was integrated.

    Args:
        scene: the scene with the integrator `substepping`, whose time step is the frame.
        motions: motion after each frame.
    """
    balance, state = EnergyBalance(scene), build_initial_state(scene)
    for motion in motions:
        problem, state = build_problem(scene, state, "previous"), MotionState(motion, None, state.index + 1)
        yield balance.add_step(build_integrated_step(problem, state))


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


def _stored_energy(energy: Energy, x: Positions, p: Positions) -> float:
    """Return the potential [J] of an energy without damping and friction."""
    if getattr(energy, "is_dissipative", False):
        return 0.0
    if isinstance(energy, ContactEnergy):
        return energy.value(x) - energy.friction_potential(x)
    return energy.value(p)


def _is_driven(energy: Energy) -> bool:
    """Return whether an energy's parameters may change between steps, except by damping or contact."""
    return is_lagged(energy) and not getattr(energy, "is_dissipative", False) and not isinstance(energy, ContactEnergy)
