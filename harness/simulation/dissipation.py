"""Dissipation by cause: where the energy of each step goes.

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
force that the scene does not have: where a solve ends early, it may supply energy as well as dissipate it. Of length
constraints, tensions are the part of the residual in the span of their gradients, and do no work in the exact motion.
Sources are changing forces, moving pins and obstacles, and energies whose parameters change, at the mean of a step's
two ends. Exactly pinned vertices have no kinetic energy; penalty pins store none at the start.

The terms are evaluated separately, so their sum tests them: it differs from the change of the energy by round-off.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.step_stages import StageSequence
from springbench.harness.simulation.time_loop import SimulationStep, build_initial_state
from springbench.solvers.contact.contact_work import ContactEnergy
from springbench.solvers.model.energies.augmented_lagrangian import concatenate_constraints
from springbench.solvers.model.integrators import RungeKutta
from springbench.solvers.model.step_problem import Energy, Positions, StepProblem, is_lagged

_ACTIVE_LENGTH_RTOL = 1e-6
"""Distance from a bound, relative to it, within which a length is taken to be constrained: solves keep lengths to
1e-9 and better."""

_REGULARISATION, _NUM_REFINEMENTS = 1e-10, 4
"""Shift of the matrix of the tensions, whose diagonal is 2, as redundant constraints make it singular; and the
refinements that remove its effect, each by a factor of the shift over an eigenvalue."""


class StepDissipation(NamedTuple):
    """Energies after a step and its dissipation by cause, each [J]; None where the cause cannot be separated.

    Attributes:
      kinetic_energy: of all vertices without an exact pin.
      potential_energy: springs, loads, penalty pins and all other potentials; loads relative to the start.
      provided_energy: energy of the start, released by loads, and positive work of sources, up to this step.
      source_work: work of sources in the step.
      dissipation_damping, dissipation_friction, dissipation_integrator, dissipation_solve: in the step.
      balance_error: change of the energy in the step that these terms do not explain.
    """

    kinetic_energy: float
    potential_energy: float | None = None
    provided_energy: float | None = None
    source_work: float | None = None
    dissipation_damping: float | None = None
    dissipation_friction: float | None = None
    dissipation_integrator: float | None = None
    dissipation_solve: float | None = None
    balance_error: float | None = None

    @property
    def columns(self) -> dict[str, Any]:
        """Columns in the rows of a frame; a value that overflows is None."""
        return {k: value if value is None or np.isfinite(value) else None for k, value in self._asdict().items()}


class _StagePower(NamedTuple):
    """Power [W] of each kind of force at a stage; or, multiplied by a time, their work [J]."""

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


class DissipationBudget:
    """Dissipation of one run, whose steps are added in order."""

    def __init__(self, scene: Scene) -> None:
        system = scene.system
        self._scene, self._motion = scene, build_initial_state(scene).motion
        self._first, self._free = self._motion.positions, system.free_vertices
        self._exact = system.pins.vertices[system.pins.exact_mask]
        self._mass, self._load = system.mass[self._free], scene.constant_force[self._free]
        self._lengths = concatenate_constraints(system.length_constraints)
        self._when = float(getattr(scene.integrator, "stage_fraction", 1.0))
        self._kinetic = self._kinetic_energy(self._motion.velocity)
        self._begun: tuple[Energy, ...] = ()
        self._potentials = np.empty(0)
        self._provided = self._released = 0.0
        self._last_power = _StagePower()

    def add_step(self, step: SimulationStep) -> StepDissipation:
        """Return the dissipation of the next step."""
        with np.errstate(over="ignore", invalid="ignore"):
            found = self._add_integrated(step) if step.solution.velocity is not None else self._add_stages(step)
        self._motion, self._kinetic = step.state.motion, found.kinetic_energy
        return found

    def _add_integrated(self, step: SimulationStep) -> StepDissipation:
        """Add a step that the solver integrated itself.

        Its forces are known at its ends only, so that the causes are separable only where nothing acts but potentials.
        """
        scene, problem, p = self._scene, step.problem, step.positions
        kinetic = self._kinetic_energy(step.state.motion.velocity)
        driven = scene.varying_forces or scene.velocity_filters or scene.pin_motions or scene.system.length_constraints
        if driven or any(map(is_lagged, problem.system.energies)):
            return StepDissipation(kinetic)
        if step.index == 1:
            self._set_start(self._evaluate_potentials(problem, self._first, self._first, 0.0))
        before, self._potentials = self._potentials, self._evaluate_potentials(problem, p, p, 0.0)
        lost = self._kinetic - kinetic + float((before - self._potentials).sum())
        return StepDissipation(
            kinetic, float(self._potentials.sum()), self._update_provided(0.0), 0.0, 0.0, 0.0, lost, None, 0.0
        )

    def _add_stages(self, step: SimulationStep) -> StepDissipation:
        problem, x, p = step.problem, step.solution.positions, step.positions
        before = self._motion.positions
        end, start = self._scene.compute_time(step.index), self._scene.compute_time(step.index - 1)
        moved = self._scene.pin_targets_at(end) - self._scene.pin_targets_at(start)
        work = self._sum_work(step, moved)
        after = self._evaluate_potentials(problem, x, p, end)
        if step.index == 1:
            at_start = self._evaluate_potentials(problem, self._first, self._first, 0.0)
            self._set_start(np.where(np.isfinite(at_start), at_start, after))
            self._begun = problem.energies
        driven = self._parameter_work(problem, after, before, p)
        kinetic = self._kinetic_energy(step.state.motion.velocity)
        filtered = self._kinetic_energy(problem.step_start.velocity)
        removed = self._kinetic - filtered
        sources = work.sources + driven - min(0.0, removed)
        changed = float((after - self._potentials).sum())
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
        dissipated = sum(value or 0.0 for value in found[4:8])
        self._potentials, self._begun = after, problem.energies
        error = kinetic - self._kinetic + changed - (sources - dissipated)
        return found._replace(provided_energy=self._update_provided(sources), balance_error=error)

    def _sum_work(self, step: SimulationStep, moved: Positions) -> _StagePower:
        """Return the work [J] of each kind of force in a step, in which pin targets are displaced by `moved` [m]."""
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
        """Return the power at the start of the run, where the acceleration is that of all forces."""
        start = step.problem.step_start
        scene = self._scene.scene_of_step(0)
        stages = StageSequence(scene, self._motion._replace(velocity=start.velocity), None, start.time)
        power = self._stage_power(stages.build_start_problem(), self._first, np.zeros_like(scene.pin_targets))
        return power._replace(inertia=-power.residual, residual=0.0)

    def _stage_power(self, problem: StepProblem, x: Positions, pin_velocity: Positions) -> _StagePower:
        """Return the power at a stage x (n, 3) [m], with pin targets at a velocity (q, 3) [m/s]."""
        system, start, free, exact = problem.system, problem.step_start, self._free, self._exact
        v, total = start.velocity_at(x), np.zeros_like(x)
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
        soft, vertices, weight = system.penalty_pins
        pull = weight[:, None] * (x[vertices] - problem.pin_targets[soft])
        potentials += _dot(pull, v[vertices] - pin_velocity[soft]) - _dot(self._load, v[free])
        sources -= _dot(pull, pin_velocity[soft])
        sources += _dot((problem.external_force - self._scene.constant_force)[free], v[free])
        for force in self._scene.varying_forces:
            if getattr(force, "is_dissipative", False):
                lost = -_dot(force(x, v, start.stage_time)[free], v[free])
                damping, sources = damping + lost, sources + lost
        residual = problem.gradient(x)
        tension = self._find_tensions(x, residual)
        sources += _dot((total - tension)[exact], v[exact])
        inertia = system.inertia_diagonal[free, None] * (x - problem.inertial_target)[free]
        return _StagePower(
            _dot(inertia, v[free]),
            potentials,
            damping,
            friction,
            sources,
            _dot((residual - tension)[free], v[free]),
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
        of_free, wanted = gradients[:, free], residual[self._free].ravel()
        normal = of_free @ of_free.T + scipy.sparse.diags_array(np.full(count, _REGULARISATION))
        factor, tensions = splu(scipy.sparse.csc_array(normal)), np.zeros(count)
        for _ in range(_NUM_REFINEMENTS):
            tensions += factor.solve(of_free @ (wanted - of_free.T @ tensions))
        return (gradients.T @ tensions).reshape(x.shape)

    def _parameter_work(
        self, problem: StepProblem, after: NDArray[np.float64], before: Positions, p: Positions
    ) -> float:
        """Return the work [J] that changing parameters of energies do in a step from positions `before` to p.

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
        soft, vertices, weight = problem.system.penalty_pins
        away = p[vertices] - self._scene.pin_targets_at(time)[soft]
        return np.array(
            [
                *(_stored_energy(energy, x, p) for energy in problem.energies),
                0.5 * self._when * weight @ np.einsum("ij,ij->i", away, away),
                -_dot(self._load, (p - self._first)[self._free]),
            ]
        )

    def _set_start(self, potentials: NDArray[np.float64]) -> None:
        """Set the potentials of the start; penalty pins are on their targets there, whatever its shape."""
        potentials[-2] = 0.0
        self._potentials = potentials
        self._provided = self._kinetic + float(np.maximum(potentials, 0.0).sum())

    def _update_provided(self, sources: float) -> float:
        """Return the energy [J] provided so far, after a step with a work of sources."""
        self._provided += max(0.0, sources)
        self._released = max(self._released, -float(np.minimum(self._potentials, 0.0).sum()))
        return self._provided + self._released

    def _kinetic_energy(self, velocity: Positions) -> float:
        v = velocity[self._free]
        return 0.5 * float(self._mass @ np.einsum("ij,ij->i", v, v))


def _stored_energy(energy: Energy, x: Positions, p: Positions) -> float:
    """Return the potential [J] of an energy without damping and friction."""
    if getattr(energy, "is_dissipative", False):
        return 0.0
    if isinstance(energy, ContactEnergy):
        return energy.value(x) - energy.friction_potential(x)
    return energy.value(p)


def _is_driven(energy: Energy) -> bool:
    """Return whether an energy's parameters may change from step to step, other than by damping or contact."""
    return is_lagged(energy) and not getattr(energy, "is_dissipative", False) and not isinstance(energy, ContactEnergy)


def _dot(a: Positions, b: Positions) -> float:
    return float(np.einsum("ij,ij->", a, b))
