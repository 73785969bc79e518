"""Instrumentation pass of a run: repeats the steps and computes the columns of the solution.

The convergence of a solve is traced independently of the solver. Where a run is recorded or its mesh is large, a second
thread processes each step while the solver computes the next one, at most one step behind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import islice
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.harness.recording.recorder_interface import RecordedFrame, RunRecorder
from springbench.harness.results.solver_phases import format_phases
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.spring_strains import compute_strains
from springbench.harness.simulation.energy_balance import (
    BLOW_UP_FACTOR,
    DissipationBudget,
    EnergyBalance,
    EnergyGain,
    StepDissipation,
)
from springbench.harness.simulation.time_loop import SimulationStep, build_initial_state
from springbench.harness.simulation.timing_pass import (
    NO_CLOCK,
    DivergenceError,
    StepError,
    SteppingSettings,
    hash_positions,
    iterate_steps,
)
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact
from springbench.solvers.iteration.phase_clock import measure_phases
from springbench.solvers.model.energies.augmented_lagrangian import length_errors
from springbench.solvers.model.step_problem import Positions, PreparedSolver, ProjectiveEnergy, StepProblem, System
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix, energy_norm


@dataclass(frozen=True, slots=True, eq=False)
class ConvergenceTrace:
    """Convergence of a solve at the iterates 1, 2, ...

    Attributes:
        residuals: |p - previous p|_Q [J^(1/2)] over the unpinned vertices.
        objective: objective [J].
    """

    residuals: list[float]
    objective: list[float]


class EnergyNorm:
    """Norm |e|_Q [J^(1/2)] over the unpinned vertices, with a Q that is assembled here."""

    def __init__(self, system: System) -> None:
        projective = [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
        self._Q: csr_array = assemble_system_matrix(system, projective)
        self._pinned = system.pins.vertices

    def __call__(self, e: Positions) -> float:
        """Compute the norm of a displacement (n, 3) [m]."""
        e = e.copy()
        e[self._pinned] = 0.0
        return energy_norm(self._Q, e)


def trace_convergence(
    prepared: PreparedSolver, problem: StepProblem, norm: EnergyNorm, iterations: int
) -> ConvergenceTrace:
    """Trace the convergence of a solve over a number of iterations.

    Args:
        prepared: prepared solver.
        problem: step problem.
        norm: norm of the residuals.
        iterations: number of iterations.
    """
    residuals, objective = list[float](), list[float]()
    previous = problem.initial_guess.copy()
    for p in islice(prepared.iterates(problem), iterations):
        residuals.append(norm(p - previous))
        objective.append(problem.value(p))
        previous[:] = p
    return ConvergenceTrace(residuals, objective)


_ENERGY_TERMS = ("springs", "inertia", "force", "pins")
"""Terms of the objective that have their own columns."""

_REASON_ORDER = ("max-iter", "saddle", "stalled", "converged", "roundoff")
"""Termination reasons of a solve, least desirable first."""


class RunObservers(NamedTuple):
    """What observes the steps of a run.

    Attributes:
        recorder: recorder of every frame and of the convergence in the frames `convergence_frames`; None for none.
        convergence_frames: frames whose convergence is recorded.
        positions_out: output array for the positions after each step, (frames, n, 3) [m]; None for none.
        sample_frame: called with each frame and its positions (n, 3) [m]; None for none.
        verify_step: returns the accuracy columns of each step; None for none.
    """

    recorder: RunRecorder | None = None
    convergence_frames: Collection[int] = ()
    positions_out: NDArray[np.float64] | None = None
    sample_frame: Callable[[int, Positions], None] | None = None
    verify_step: Callable[[SimulationStep], dict[str, Any]] | None = None


_MIN_VERTICES_OF_THREAD = 3_000
"""Number of vertices from which on a second thread saves more time than the exchange of a step with it takes."""


def _call_at_once(function: Callable[..., None], *arguments: Any) -> Future[None]:
    """Call a function in this thread, with the result of an executor's `submit`."""
    done = Future[None]()
    done.set_result(function(*arguments))
    return done


def observe_run(
    scene: Scene,
    prepared: PreparedSolver,
    settings: SteppingSettings,
    observers: RunObservers,
    tick: Callable[[str], None],
    clock: AbstractContextManager[None] = NO_CLOCK,
) -> dict[int, dict[str, Any]]:
    """Simulate a run's frames and return the solution columns of its rows by frame.

    Args:
        scene: scene that is stepped.
        prepared: prepared solver.
        settings: settings of the time stepping.
        observers: what observes the steps.
        tick: called with the name of the pass after each step.
        clock: context within which each step is computed.

    Raises:
        StepError: a step failed, or, caused by DivergenceError, the energy diverges.
    """
    recorder, convergence_frames, positions_out, sample_frame, verify_step = observers
    found: dict[int, dict[str, Any]] = {}
    energy = EnergyBalance(scene)
    budget = DissipationBudget(scene, has_inner_solves=getattr(prepared, "has_inner_solves", False))

    def observe_step(step: SimulationStep, residual: float, balance: EnergyGain, dissipation: StepDissipation) -> None:
        terms = step.problem.evaluate_terms(step.solution.positions)
        found[step.index] = columns = build_solution_columns(scene, step, terms, residual) | (
            verify_step(step) if verify_step else {}
        )
        columns |= balance.columns | dissipation.columns
        if positions_out is not None:
            positions_out[step.index - 1] = step.positions
        if sample_frame:
            sample_frame(step.index, step.positions)
        if recorder:
            drawn = terms, residual, step.num_iterations, collect_forces(step), columns["num_intersections"]
            recorder.record_frame(RecordedFrame(step.index, scene.compute_time(step.index), step.positions, *drawn))

    is_small = recorder is None and len(scene.mesh.rest_positions) < _MIN_VERTICES_OF_THREAD
    with ThreadPoolExecutor(1) as executor, measure_phases(thread_time):  # whose thread starts at the first call
        submit_call = _call_at_once if is_small else executor.submit
        observed: Future[None] | None = None
        if recorder:
            observed = submit_call(
                recorder.record_frame,
                RecordedFrame(0, 0.0, build_initial_state(scene).motion.positions, {}, float("nan"), 0),
            )
        for step in iterate_steps(scene, prepared, settings, clock):
            if observed:
                observed.result()  # raises here the exception of that thread
            # A solver's memory may be reused by the next solve, so it is not read concurrently with the next step.
            balance = energy.add_step(step)
            if balance.is_above(BLOW_UP_FACTOR):
                raise StepError(step.index) from DivergenceError(f"from frame {step.index} on the motion has {balance}")
            dissipation = budget.add_step(step)
            observed = submit_call(observe_step, step, compute_returned_residual(prepared, step), balance, dissipation)
            if recorder and step.index in convergence_frames:
                norm = EnergyNorm(step.problem.system)
                # A further round of friction starts where the previous one ended; only the first one is drawn.
                shown = step.iteration_counts[0] if step.friction_rounds else step.solution.num_iterations
                curve = trace_convergence(prepared, step.problem, norm, shown)
                observed.result()
                recorder.record_convergence(step.index, curve.residuals, curve.objective)
            tick("second pass")
        if observed:
            observed.result()
    return found


def build_solution_columns(
    scene: Scene, step: SimulationStep, terms: Mapping[str, float], residual: float
) -> dict[str, Any]:
    """Build the solution columns of a step's rows.

    Args:
        scene: scene that is stepped.
        step: completed step.
        terms: terms of the objective [J].
        residual: residual norm [J^(1/2)] at the step's positions.
    """
    p, s = step.positions, step.solution
    return {
        **{f"energy_{name}": terms[name] for name in _ENERGY_TERMS if name in terms},
        "energy_effects": sum(value for name, value in terms.items() if name not in _ENERGY_TERMS),
        "objective": sum(terms.values()),
        **compute_strain_columns(scene, p),
        "max_length_error": compute_max_length_error(scene, p),
        "penetration_depth": compute_penetration(scene, p, scene.compute_time(step.index)),
        "num_intersections": count_intersections(scene, p, scene.compute_time(step.index)),
        "num_iterations": step.num_iterations,
        "num_stages": len(step.stages),
        "friction_iterations": step.friction_rounds.num_iterations if step.friction_rounds else None,
        "friction_relative_change": step.friction_rounds.relative_change if step.friction_rounds else None,
        "termination_reason": find_termination_reason(step),
        "solver_phases": format_phases(solution.solver_phases or {} for _, solution in step.stages),
        "residual": residual,
        "residual_last": s.residual,
        "residual_iterate": s.residual_iterate,
        "residual_initial": s.initial_residual,
        "residual_atol": step.stop_rule.atol or None,
        "positions_digest": hash_positions(p),
    }


def collect_forces(step: SimulationStep) -> dict[str, Positions]:
    """Collect the external and contact forces (n, 3) [N] at a step's end, by name."""
    found, p = {"external": step.problem.external_force}, step.solution.positions
    contacts = [energy for energy in step.problem.energies if isinstance(energy, HalfSpaceContact)]
    if contacts:
        downhill = np.zeros_like(p)
        for contact in contacts:
            contact.add_gradient(p, downhill)
        found["contact"] = -downhill
    return found


def compute_penetration(scene: Scene, p: Positions, time: float) -> float | None:
    """Compute the largest depth [m] of a vertex inside an obstacle; None without obstacles.

    Args:
        scene: scene with obstacles.
        p: positions (n, 3) [m].
        time: time [s].
    """
    contacts = [energy for energy in scene.system.energies if isinstance(energy, HalfSpaceContact)]
    inside = [-one.signed_distance(p, time).min(initial=0.0) for contact in contacts for one in contact.obstacles]
    return float(max(inside)) if inside else None


def count_intersections(scene: Scene, p: Positions, time: float) -> int | None:
    """Count the edge-triangle intersections of the mesh with itself and with obstacle surfaces.

    Args:
        scene: scene with obstacles.
        p: positions (n, 3) [m].
        time: time [s].

    Returns:
        Their number; None where no effect prevents intersections.
    """
    return (
        sum(len(one.find_intersections(p, time)) for one in scene.intersection_checks)
        if scene.intersection_checks
        else None
    )


def compute_returned_residual(prepared: PreparedSolver, step: SimulationStep) -> float:
    """Compute the residual [J^(1/2)] at the positions that a step's solve returned.

    It costs an iteration where the solver reports the residual of the previous iterate only.

    Args:
        prepared: solver of the step.
        step: completed step, of which the last stage counts.
    """
    solution = step.solution
    if solution.residual_iterate == "previous":
        return prepared.residual_at(step.problem, solution.positions)
    return solution.residual


def find_termination_reason(step: SimulationStep) -> str:
    """Return the termination reason of the least converged stage."""
    return min((solution.termination_reason for _, solution in step.stages), key=_REASON_ORDER.index)


def compute_strain_columns(scene: Scene, p: Positions) -> dict[str, float]:
    """Compute the strain columns: the largest absolute strain and the 99th percentile.

    The strain of a spring is |length / rest length - 1|.

    Args:
        scene: scene with the springs.
        p: positions (n, 3) [m].

    Returns:
        The columns `max_strain` and `strain_p99`, both 0 without springs.
    """
    of_spring, _ = compute_strains(p, scene.all_springs.edges, scene.all_springs.rest_length)
    strain = np.abs(of_spring)
    percentile = float(np.percentile(strain, 99)) if len(strain) else 0.0
    return {"max_strain": float(strain.max(initial=0.0)), "strain_p99": percentile}


def compute_max_length_error(scene: Scene, p: Positions) -> float | None:
    """Compute the largest error of an exact length, relative to its maximum length.

    Args:
        scene: scene with the lengths.
        p: positions (n, 3) [m].

    Returns:
        The error, None without exact lengths.
    """
    errors = [
        np.abs(length_errors(lengths, p) / lengths.max_length).max(initial=0.0)
        for lengths in scene.system.length_constraints
    ]
    return float(max(errors)) if errors else None


def require_finite(columns_by_frame: Mapping[int, dict[str, Any]], *, is_minimiser: bool, has_rtol: bool) -> None:
    """Require finite columns of each frame, and set columns that do not apply to None.

    Args:
        columns_by_frame: columns by frame.
        is_minimiser: whether the solver has a residual.
        has_rtol: whether it has a relative tolerance, which uses the initial residual.

    Raises:
        StepError: caused by DivergenceError, where a column is infinite or NaN.
    """
    known = {"residual": is_minimiser, "residual_last": is_minimiser, "residual_initial": is_minimiser and has_rtol}
    for frame, columns in columns_by_frame.items():
        columns.update({name: None for name, has in known.items() if name in columns and not has})
        for name, value in columns.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise StepError(frame) from DivergenceError(
                    f"{name} is {value} from frame {frame} on, although all positions are finite"
                )
