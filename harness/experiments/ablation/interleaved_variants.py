"""Measure the cost and the motion of scene variants, interleaved step by step.

All variants run in one process.

In each round every scene is simulated from its start, one step of each after the other, so that a drift of the machine
affects all alike. Times are CPU times of the one computing thread, on which other programs have little influence. The
cost of an effect is a difference of times of the same frame in the same round:

    cost = mean over frames of the median over rounds of (full scene - scene without the effect)

`springbench.harness.results.bootstrap_statistics` computes its 95 % interval.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import thread_time

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError
from springbench.harness.execution.worker_process import ProgressCallback
from springbench.harness.experiments.ablation.scene_variants import SceneVariant
from springbench.harness.results.bootstrap_statistics import ConfidenceInterval, estimate_added_time
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.time_loop import SimulationStep, prepare
from springbench.harness.simulation.timing_pass import StepError, SteppingSettings, iterate_steps
from springbench.solvers.model.step_problem import NotPositiveDefinite, PreparedSolver, Solver, Unsupported

FloatArray = NDArray[np.float64]


@dataclass(eq=False)
class VariantRun:
    """Running simulation of a variant.

    Attributes:
        variant: the scene variant.
        scene: the scene; None if it could not be built.
        prepared: the prepared solver; None if preparation failed.
        memory_bytes: memory of the scene and the prepared solver.
        failure_reason: why there is no result; empty if there is one.
        seconds: CPU time of the steps, (rounds, frames) [s].
        positions: (frames, n, 3) [m].
        velocities: (frames, n, 3) [m/s].
    """

    variant: SceneVariant
    scene: Scene | None = None
    prepared: PreparedSolver | None = None
    memory_bytes: int = 0
    failure_reason: str = ""
    seconds: list[list[float]] = field(default_factory=list[list[float]])
    positions: FloatArray = field(default_factory=lambda: np.empty(0))
    velocities: FloatArray = field(default_factory=lambda: np.empty(0))


def time_interleaved(
    variants: Sequence[SceneVariant],
    size: int,
    integrator: str,
    solver: Solver,
    settings: SteppingSettings,
    tick: ProgressCallback,
) -> list[VariantRun]:
    """Simulate every variant `rounds` times, interleaved, after a warm-up pass that stores the motion.

    Args:
        variants: the full scene, then the others.
        size: mesh size.
        integrator: name of the integrator.
        solver: the solver.
        settings: settings of the simulations.
        tick: called after each motion and each round.

    Returns:
        The runs in the order of the variants.

    Raises:
        InputError: the full scene is invalid; other variants store the reason.
        Unsupported: the solver does not support the full scene; other variants store the reason.
    """
    _prepare_variant(variants[0], size, integrator, solver)  # so that compilation and imports are not counted as memory
    found = [_prepare_variant(variant, size, integrator, solver) for variant in variants]
    for turn in found:
        _store_motion(turn, settings)
        tick("motion")
    for round in range(settings.rounds):
        # The order rotates from round to round: the first one after a pause has cold caches.
        alive = [turn for turn in found if not turn.failure_reason]
        alive = alive[round % len(alive) :] + alive[: round % len(alive)]
        for turn in alive:
            turn.seconds.append([])
        running = [_iterate_steps(turn, settings) for turn in alive]
        for _ in range(settings.frames):
            for turn, run in zip(alive, running, strict=True):
                began = thread_time()
                next(run)
                turn.seconds[-1].append(thread_time() - began)
        tick("timed rounds")
    return found


def compute_cost(full: VariantRun, without: VariantRun) -> ConfidenceInterval:
    """Return the CPU time per step that the full scene takes in addition [s].

    Args:
        full: timed run of the full scene.
        without: timed run of the variant, interleaved with it; it has as many rounds and frames.
    """
    return estimate_added_time(np.array(full.seconds) - np.array(without.seconds))


def compute_step_seconds(variant_run: VariantRun) -> float:
    """Return the CPU time per step [s].

    This is the mean over the frames of the median over the rounds.
    """
    return float(np.median(np.array(variant_run.seconds), axis=0).mean())


def _prepare_variant(variant: SceneVariant, size: int, integrator: str, solver: Solver) -> VariantRun:
    turn = VariantRun(variant)
    tracemalloc.start()
    try:
        turn.scene = build_scene(variant.scene, size, integrator)
        turn.prepared = prepare(turn.scene, solver)
        turn.memory_bytes = tracemalloc.get_traced_memory()[0]
    except (InputError, NotPositiveDefinite, Unsupported) as error:
        if not variant.omitted_effects:
            raise
        turn.failure_reason = str(error)
    finally:
        tracemalloc.stop()
    return turn


def _store_motion(variant_run: VariantRun, settings: SteppingSettings) -> None:
    """Simulate once, and store positions and velocities."""
    if variant_run.failure_reason:
        return
    try:
        frames = [
            (step.state.motion.positions, step.state.motion.velocity) for step in _iterate_steps(variant_run, settings)
        ]
    except StepError as error:
        if not variant_run.variant.omitted_effects:
            raise
        variant_run.failure_reason = f"{error}: {error.__cause__}"
        return
    variant_run.positions, variant_run.velocities = (np.array(part) for part in zip(*frames, strict=True))


def _iterate_steps(variant_run: VariantRun, settings: SteppingSettings) -> Iterator[SimulationStep]:
    assert variant_run.scene is not None
    assert variant_run.prepared is not None
    return iterate_steps(variant_run.scene, variant_run.prepared, settings)


def simulate_motion(
    scene: Scene, solver: Solver, settings: SteppingSettings, *, stride: int = 1
) -> tuple[FloatArray, FloatArray]:
    """Simulate, and return positions and velocities (frames, n, 3) of every `stride`-th step.

    Args:
        scene: the scene.
        solver: the solver.
        settings: settings, whose number of frames is that of the result.
        stride: number of steps per frame of the result.
    """
    run = replace(settings, frames=settings.frames * stride)
    motions = [s.state.motion for s in iterate_steps(scene, prepare(scene, solver), run) if s.index % stride == 0]
    return np.array([now.positions for now in motions]), np.array([now.velocity for now in motions])
