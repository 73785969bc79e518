"""Measure the cost and the motion of scene variants, interleaved step by step.

All variants run in one process.

In each round every scene is simulated from its start, one step of each after the other, so that a drift of the machine
affects all alike. Times are CPU times of the one computing thread, on which other programs have little influence. The
cost of an effect is a difference of times of the same frame in the same round:

    cost = mean over frames of the median over rounds of (full scene - scene without the effect)

`harness.base.statistics` computes its 95 % interval.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import thread_time

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import InputError
from harness.base.statistics import Interval, added
from harness.base.worker import Tick
from harness.experiments.ablation.variants import Variant
from harness.scenes.bind import Scene, build
from harness.simulation.measure import Settings, StepFailed, steps
from harness.simulation.step import Step, prepare
from solvers.problem import NotPositiveDefinite, Prepared, Solver, Unsupported

Array = NDArray[np.float64]


@dataclass(eq=False)
class Contender:
    """Running simulation of a variant.

    Attributes:
        variant: the scene variant.
        scene: the scene; None if it could not be built.
        prepared: the prepared solver; None if preparation failed.
        bytes: memory of the scene and the prepared solver.
        failure: why there is no result; empty if there is one.
        seconds: CPU time of the steps, (rounds, frames) [s].
        positions: (frames, n, 3) [m].
        velocities: (frames, n, 3) [m/s].
    """

    variant: Variant
    scene: Scene | None = None
    prepared: Prepared | None = None
    bytes: int = 0
    failure: str = ""
    seconds: list[list[float]] = field(default_factory=list[list[float]])
    positions: Array = field(default_factory=lambda: np.empty(0))
    velocities: Array = field(default_factory=lambda: np.empty(0))


def turns(
    variants: Sequence[Variant],
    size: int,
    integrator: str,
    solver: Solver,
    settings: Settings,
    tick: Tick,
) -> list[Contender]:
    """Simulate every variant `rounds` times, interleaved, after a warm-up pass that stores the motion.

    Args:
        variants: the full scene, then the others.
        size: mesh size.
        integrator: name of the integrator.
        solver: the solver.
        settings: settings of the simulations.
        tick: called after each motion and each round.

    Raises:
        InputError: the full scene is invalid; other variants store the reason.
        Unsupported: the solver does not support the full scene; other variants store the reason.
    """
    _prepared(variants[0], size, integrator, solver)  # what is compiled and imported is not the scene's memory
    found = [_prepared(variant, size, integrator, solver) for variant in variants]
    for turn in found:
        _keep_motion(turn, settings)
        tick("motion")
    for round in range(settings.rounds):
        # The order rotates from round to round: the first one after a pause has cold caches.
        alive = [turn for turn in found if not turn.failure]
        alive = alive[round % len(alive) :] + alive[: round % len(alive)]
        for turn in alive:
            turn.seconds.append([])
        running = [_steps(turn, settings) for turn in alive]
        for _ in range(settings.frames):
            for turn, run in zip(alive, running, strict=True):
                began = thread_time()
                next(run)
                turn.seconds[-1].append(thread_time() - began)
        tick("timed rounds")
    return found


def cost(whole: Contender, without: Contender) -> Interval:
    """Return the CPU time per step that the full scene takes in addition [s]."""
    return added(np.array(whole.seconds) - np.array(without.seconds))


def seconds(turn: Contender) -> float:
    """Return the CPU time per step [s].

    This is the mean over the frames of the median over the rounds.
    """
    return float(np.median(np.array(turn.seconds), axis=0).mean())


def _prepared(variant: Variant, size: int, integrator: str, solver: Solver) -> Contender:
    turn = Contender(variant)
    tracemalloc.start()
    try:
        turn.scene = build(variant.scene, size, integrator)
        turn.prepared = prepare(turn.scene, solver)
        turn.bytes = tracemalloc.get_traced_memory()[0]
    except (InputError, NotPositiveDefinite, Unsupported) as error:
        if not variant.left_out:
            raise
        turn.failure = str(error)
    finally:
        tracemalloc.stop()
    return turn


def _keep_motion(turn: Contender, settings: Settings) -> None:
    """Simulate once, and store positions and velocities."""
    if turn.failure:
        return
    try:
        kept = [(step.state.now.positions, step.state.now.velocity) for step in _steps(turn, settings)]
    except StepFailed as error:
        if not turn.variant.left_out:
            raise
        turn.failure = f"{error}: {error.__cause__}"
        return
    turn.positions, turn.velocities = (np.array(part) for part in zip(*kept, strict=True))


def _steps(turn: Contender, settings: Settings) -> Iterator[Step]:
    assert turn.scene is not None
    assert turn.prepared is not None
    return steps(turn.scene, turn.prepared, settings)


def motion(scene: Scene, solver: Solver, settings: Settings, *, every: int = 1) -> tuple[Array, Array]:
    """Simulate, and return positions and velocities (frames, n, 3) of every `every`-th step.

    Args:
        scene: the scene.
        solver: the solver.
        settings: settings, whose number of frames is that of the result.
        every: number of steps per frame of the result.
    """
    run = replace(settings, frames=settings.frames * every)
    kept = [s.state.now for s in steps(scene, prepare(scene, solver), run) if s.index % every == 0]
    return np.array([now.positions for now in kept]), np.array([now.velocity for now in kept])
