"""Instrumentation pass of a run: repeats the steps and computes the columns of the solution.

A second thread processes each step while the solver computes the next one, at most one step behind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.record.base import Frame, Recorder
from harness.record.shading import strains
from harness.scenes.bind import Scene
from harness.simulation.energy_balance import BLOW_UP, Balance, EnergyBalance
from harness.simulation.measure import NO_CLOCK, Diverged, Settings, StepFailed, digest, steps
from harness.simulation.step import Step, start
from harness.simulation.trace import EnergyNorm, trace
from solvers.contact.energy import Contact
from solvers.energies.augmented import off
from solvers.problem import Positions, Prepared

_OWN = ("springs", "inertia", "force", "pins")
"""Terms of the objective that have their own columns."""

_WORST = ("iterations", "stalled", "tolerance", "floor")
"""Termination reasons of a solve, least desirable first."""


def observe(
    scene: Scene,
    prepared: Prepared,
    settings: Settings,
    *,
    recorder: Recorder | None,
    convergence: Collection[int],
    stored: NDArray[np.float64] | None,
    sample: Callable[[int, Positions], None] | None = None,
    judge: Callable[[Step], dict[str, Any]] | None,
    tick: Callable[[], None],
    clock: AbstractContextManager[None] = NO_CLOCK,
) -> dict[int, dict[str, Any]]:
    """Simulate a run's frames and return the solution columns of its rows by frame.

    Args:
      scene: scene that is stepped.
      prepared: prepared solver.
      settings: settings of the time stepping.
      recorder: recorder of every frame and of the convergence in the frames `convergence`.
      convergence: frames whose convergence is recorded.
      stored: output array for the positions after each step, (frames, n, 3) [m].
      sample: called with each frame and its positions (n, 3) [m].
      judge: returns the accuracy columns of each step.
      tick: called after each step.
      clock: context within which each step is computed.

    Raises:
      StepFailed: a step failed, or, caused by Diverged, the energy diverges.
    """
    found: dict[int, dict[str, Any]] = {}
    energy = EnergyBalance(scene)

    def look(step: Step, residual: float, balance: Balance) -> None:
        terms = step.problem.terms(step.solution.positions)
        found[step.index] = told = columns(scene, step, terms, residual) | (judge(step) if judge else {})
        told |= {"energy_gained": balance.gained, "energy_available": balance.available}
        if stored is not None:
            stored[step.index - 1] = step.positions
        if sample:
            sample(step.index, step.positions)
        if recorder:
            drawn = terms, residual, step.iterations, acting(step), told["intersections"]
            recorder.frame(Frame(step.index, scene.time(step.index), step.positions, *drawn))

    with ThreadPoolExecutor(1) as beside:
        looked: Future[None] | None = None
        if recorder:
            looked = beside.submit(recorder.frame, Frame(0, 0.0, start(scene).now.positions, {}, float("nan"), 0))
        for step in steps(scene, prepared, settings, clock):
            if looked:
                looked.result()  # raises here what went wrong there
            # A solver's memory may be reused by the next solve, so it is not read concurrently with the next step.
            balance = energy.after(step)
            if balance.exceeds(BLOW_UP):
                raise StepFailed(step.index) from Diverged(f"from frame {step.index} on the motion has {balance}")
            looked = beside.submit(look, step, returned_residual(prepared, step), balance)
            if recorder and step.index in convergence:
                norm = EnergyNorm(step.problem.system)
                # A further round of friction starts where the previous one ended; only the first one is drawn.
                shown = step.counts[0] if step.friction else step.solution.iterations
                curve = trace(prepared, step.problem, norm, shown)
                looked.result()
                recorder.convergence(step.index, curve.residuals, curve.objective)
            tick()
        if looked:
            looked.result()
    return found


def columns(scene: Scene, step: Step, terms: Mapping[str, float], residual: float) -> dict[str, Any]:
    """Build the solution columns of a step's rows.

    Args:
      scene: scene that is stepped.
      step: completed step.
      terms: terms of the objective [J].
      residual: residual norm [J^(1/2)] at the step's positions.
    """
    p, s = step.positions, step.solution
    return {
        **{f"energy_{name}": terms[name] for name in _OWN if name in terms},
        "energy_effects": sum(value for name, value in terms.items() if name not in _OWN),
        "objective": sum(terms.values()),
        **strain_of(scene, p),
        "off": off_of(scene, p),
        "penetration": penetration(scene, p, scene.time(step.index)),
        "intersections": intersections(scene, p, scene.time(step.index)),
        "iterations": step.iterations,
        "stages": len(step.stages),
        "friction_rounds": step.friction.rounds if step.friction else None,
        "friction_change": step.friction.change if step.friction else None,
        "stopped": stopped(step),
        "residual": residual,
        "last_residual": s.residual,
        "residual_of": s.residual_of,
        "yardstick": s.yardstick,
        "within": step.stop.within or None,
        "digest": digest(p),
    }


def acting(step: Step) -> dict[str, Positions]:
    """Collect the external and contact forces (n, 3) [N] at a step's end, by name."""
    found, p = {"external": step.problem.force}, step.solution.positions
    contacts = [energy for energy in step.problem.energies if isinstance(energy, Contact)]
    if contacts:
        downhill = np.zeros_like(p)
        for contact in contacts:
            contact.add_gradient(p, downhill)
        found["contact"] = -downhill
    return found


def penetration(scene: Scene, p: Positions, time: float) -> float | None:
    """Compute the largest depth [m] of a vertex inside an obstacle; None without obstacles.

    Args:
      scene: scene with obstacles.
      p: positions (n, 3) [m].
      time: time [s].
    """
    contacts = [energy for energy in scene.system.energies if isinstance(energy, Contact)]
    inside = [-one.distance(p, time).min(initial=0.0) for contact in contacts for one in contact.obstacles]
    return float(max(inside)) if inside else None


def intersections(scene: Scene, p: Positions, time: float) -> int | None:
    """Count the edge-triangle intersections of the mesh with itself and with obstacle surfaces.

    Args:
      scene: scene with obstacles.
      p: positions (n, 3) [m].
      time: time [s].

    Returns: their number; None where no effect prevents intersections.
    """
    return sum(len(one.crossings(p, time)) for one in scene.apart) if scene.apart else None


def returned_residual(prepared: Prepared, step: Step) -> float:
    """Compute the residual [J^(1/2)] at the positions that a step's solve returned.

    It costs an iteration where the solver reports the residual of the previous iterate only.
    """
    solution = step.solution
    if solution.residual_of == "previous":
        return prepared.residual_at(step.problem, solution.positions)
    return solution.residual


def stopped(step: Step) -> str:
    """Return the termination reason of the least converged stage."""
    return min((solution.stopped for _, solution in step.stages), key=_WORST.index)


def strain_of(scene: Scene, p: Positions) -> dict[str, float]:
    """Compute the strain columns: the largest absolute strain of a spring and its 99th percentile.

    The strain is |length / rest length - 1| at p (n, 3) [m]; both columns are 0 without springs.
    """
    of_spring, _ = strains(p, scene.springs.edges, scene.springs.rest_length)
    strain = np.abs(of_spring)
    percentile = float(np.percentile(strain, 99)) if len(strain) else 0.0
    return {"largest_strain": float(strain.max(initial=0.0)), "strain_99": percentile}


def off_of(scene: Scene, p: Positions) -> float | None:
    """Compute the largest error of an exact length, relative to its maximum length.

    Args:
      scene: scene with the lengths.
      p: positions (n, 3) [m].

    Returns: the error, None without exact lengths.
    """
    errors = [np.abs(off(lengths, p) / lengths.high).max(initial=0.0) for lengths in scene.system.lengths]
    return float(max(errors)) if errors else None


def require_numbers(by_frame: Mapping[int, dict[str, Any]], *, minimises: bool, tolerance: bool) -> None:
    """Require finite columns of each frame, and set columns that do not apply to None.

    Args:
      by_frame: columns by frame.
      minimises: whether the solver has a residual.
      tolerance: whether it has a relative tolerance, which uses the initial residual.

    Raises:
      StepFailed: caused by Diverged, where a column is infinite or NaN.
    """
    known = {"residual": minimises, "last_residual": minimises, "yardstick": minimises and tolerance}
    for frame, columns in by_frame.items():
        columns.update({name: None for name, has in known.items() if name in columns and not has})
        for name, value in columns.items():
            if isinstance(value, float) and not math.isfinite(value):
                raise StepFailed(frame) from Diverged(f"{name} is {value} from frame {frame} on, of finite positions")
