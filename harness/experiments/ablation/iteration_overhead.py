"""Measure the per-iteration overhead of each effect with each solver.

    ratio = median over rounds of (CPU time per iteration with the effect) / (CPU time per iteration without it)

The baseline scene has only the effects whose class sets `is_baseline_effect`. Both scenes are simulated interleaved,
step by step, to the requested tolerance, so that a drift of the machine affects both alike. Rounds end once the
interval of the ratio is narrower than MAX_INTERVAL_WIDTH, or at the largest number of rounds. A round that has taken
MAX_ROUND_SECONDS ends with the next counted step, and then MIN_ROUNDS rounds suffice. Where a single step takes that
long, the number of iterations per step is reduced. This limits the time of the slowest solvers to minutes.

No iteration can read the effect's own numbers faster than a dot product, nor multiply and add them faster than a matrix
product. The slower of the two is the lower bound of each ratio. An element that couples k vertices counts as 12 k
flops, those of A p and of A'f for three coordinates; other operations are not counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from time import perf_counter, thread_time
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_array
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.results.bootstrap_statistics import ConfidenceInterval, estimate_ratio
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.auto_tolerance import StopCriterion
from springbench.harness.simulation.time_loop import SimulationStep, prepare, simulate_scene
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import (
    NotPositiveDefinite,
    PreparedSolver,
    ProjectiveEnergy,
    Solver,
    Unsupported,
)
from springbench.solvers.registry import load_target

ALL_EFFECTS = "all"
"""Name of all effects together."""
MAX_INTERVAL_WIDTH, MIN_ROUNDS = 0.03, 3
"""Relative width of the interval at which rounds end; number of rounds that an interval needs."""
NUM_WARMUP_STEPS = 2
"""Number of steps before those that count."""
MAX_ROUND_SECONDS = 2.0
"""CPU time of both scenes' steps after which a round has only one more counted step [s]."""
_NUM_REPEATS = 20
_MATRIX_SIZE = 256
"""Size of the matrices whose product determines the peak number of flops per second."""


PreparedScene = tuple[Scene, PreparedSolver]
"""Scene, and the solver prepared for it."""


class EffectOverhead(NamedTuple):
    """Per-iteration overhead of an effect.

    Attributes:
        effect_kind: kind of the effect.
        ratio_interval: CPU time per iteration with the effect, divided by that without, with its interval.
        seconds: CPU time per iteration with the effect [s].
        min_ratio: lower bound of the ratio, from the effect's own bytes and flops.
        num_rounds: number of rounds.
        max_iterations: iteration limit of a step.
        unsupported_reason: why there is no measurement; empty if there is one.
    """

    effect_kind: str
    ratio_interval: ConfidenceInterval = ConfidenceInterval(np.nan, np.nan, np.nan)
    seconds: float = np.nan
    min_ratio: float = np.nan
    num_rounds: int = 0
    max_iterations: int = 0
    unsupported_reason: str = ""


@dataclass(eq=False)
class _TimedRun:
    """Running simulation of a scene by one solver.

    `seconds` and `iterations` are those of the counted steps, `total_seconds` those of all steps [s].
    """

    steps: Iterator[SimulationStep]
    seconds: float = 0.0
    iterations: int = 0
    total_seconds: float = 0.0

    def run_step(self, *, is_counted: bool) -> None:
        """Compute the next step; it is included in `seconds` and `iterations` if `is_counted`."""
        began = thread_time()
        done = next(self.steps)
        took = thread_time() - began
        self.total_seconds += took
        if is_counted:
            self.seconds += took
            self.iterations += done.num_iterations

    @property
    def seconds_per_iteration(self) -> float:
        """CPU time per iteration [s]."""
        return self.seconds / max(1, self.iterations)


def list_measured_effects(scene: SceneSpec) -> list[str]:
    """Return the kinds of effects to measure, then ALL_EFFECTS. Raises InputError if there are none."""
    kinds = list(dict.fromkeys(effect.kind for effect in scene.effects if not _is_baseline_effect(effect)))
    if not kinds:
        listed = ", ".join(dict.fromkeys(effect.kind for effect in scene.effects))
        measured = [kind for kind, target in EFFECT_CLASSES.items() if not _is_baseline_effect(load_target(target))]
        problem = f"got {listed or 'none'}, which are part of the baseline; add one whose overhead can be measured: "
        raise InputError(InputMistake(problem + ", ".join(sorted(measured)), scene.path, key="effects"))
    return [*kinds, ALL_EFFECTS]


def select_effects(scene: SceneSpec, *kinds: str) -> SceneSpec:
    """Return the scene with some effects and the baseline effects only.

    Args:
        scene: scene with all of its effects.
        kinds: kinds of the effects to select; ALL_EFFECTS selects all.
    """
    if ALL_EFFECTS in kinds:
        return scene
    selected = [i for i, e in enumerate(scene.effects) if e.kind in kinds or _is_baseline_effect(e)]
    return scene.model_copy(update=scene.select_effect_fields(selected))


def _is_baseline_effect(effect: SceneEffect | type[SceneEffect]) -> bool:
    """Return whether an effect, or a class of effects, is declared part of the baseline."""
    return bool(getattr(effect, "is_baseline_effect", False))


def measure_overheads(
    scene: SceneSpec,
    size: int,
    solver: Solver,
    stop_rule: StopCriterion,
    *,
    integrator: str,
    initial_guess: str,
    frames: int,
    max_rounds: int,
) -> Iterator[EffectOverhead]:
    """Measure the overhead of each effect with one solver; unsupported effects yield a reason.

    Args:
        scene: the scene.
        size: mesh size.
        solver: the solver.
        stop_rule: stop rule of a step.
        integrator: name of the integrator.
        initial_guess: name of the initial guess.
        frames: number of counted steps in a round.
        max_rounds: largest number of rounds.
    """
    plain = None
    for effect in list_measured_effects(scene):
        try:
            if plain is None:
                plain = prepare_scene(scene, size, solver, integrator=integrator)
                stop_rule = _limit_iterations(plain, stop_rule, initial_guess)
            yield measure_overhead(
                effect,
                prepare_scene(scene, size, solver, effect, integrator=integrator),
                plain,
                stop_rule,
                initial_guess=initial_guess,
                frames=frames,
                max_rounds=max_rounds,
            )
        except (InputError, NotPositiveDefinite, Unsupported) as error:
            yield EffectOverhead(effect, unsupported_reason=str(error))


def prepare_scene(
    scene: SceneSpec, size: int, solver: Solver, *effects: str, integrator: str = "implicit-euler"
) -> PreparedScene:
    """Build the scene with some effects and the baseline effects, and prepare the solver.

    Args:
        scene: scene with all of its effects.
        size: mesh size.
        solver: solver to prepare.
        effects: kinds of the effects to select; ALL_EFFECTS selects all.
        integrator: name of the integrator.

    Returns:
        The built scene, and the solver prepared for its system.

    Raises:
        InputError: the scene cannot be built.
        NotPositiveDefinite: the system matrix is not positive definite.
        Unsupported: the solver does not support an effect.
    """
    made = build_scene(select_effects(scene, *effects), size, integrator)
    return made, prepare(made, solver)


def measure_overhead(
    effect: str,
    with_effect: PreparedScene,
    baseline: PreparedScene,
    stop_rule: StopCriterion,
    *,
    initial_guess: str,
    frames: int,
    max_rounds: int,
) -> EffectOverhead:
    """Measure the overhead of an effect from scenes with and without it.

    Args:
        effect: kind of the effect.
        with_effect: scene with the effect.
        baseline: scene without it.
        stop_rule: stop rule of a step.
        initial_guess: name of the initial guess.
        frames: number of counted steps in a round.
        max_rounds: largest number of rounds.
    """
    pairs: list[tuple[float, float]] = []
    found = ConfidenceInterval(np.nan, np.nan, np.nan)
    while len(pairs) < max_rounds:
        runs = [
            _TimedRun(
                iter(simulate_scene(*it, stop_rule, initial_guess=initial_guess, frames=NUM_WARMUP_STEPS + frames))
            )
            for it in (with_effect, baseline)
        ]
        enough = False
        for k in range(NUM_WARMUP_STEPS + frames):
            last = enough
            for run in runs[:: 1 if len(pairs) % 2 else -1]:
                run.run_step(is_counted=last or k >= NUM_WARMUP_STEPS)
            enough = sum(run.total_seconds for run in runs) > MAX_ROUND_SECONDS
            if last or (enough and k >= NUM_WARMUP_STEPS):
                break
        pairs.append((runs[0].seconds_per_iteration, runs[1].seconds_per_iteration))
        found = estimate_ratio(*np.array(pairs).T)
        if len(pairs) >= MIN_ROUNDS and (enough or found.high - found.low <= MAX_INTERVAL_WIDTH * found.estimate):
            break
    each, without = np.array(pairs).min(axis=0)
    return EffectOverhead(
        effect,
        found,
        float(each),
        1.0 + _compute_min_seconds(with_effect[0]) / without,
        len(pairs),
        stop_rule.max_iterations,
    )


def _limit_iterations(baseline: PreparedScene, stop_rule: StopCriterion, initial_guess: str) -> StopCriterion:
    """Return the stop rule, with fewer iterations if a step takes longer than MAX_ROUND_SECONDS.

    The reduced number of iterations takes a quarter of that time.
    """
    run = _TimedRun(iter(simulate_scene(*baseline, stop_rule, initial_guess=initial_guess, frames=NUM_WARMUP_STEPS)))
    for k in range(NUM_WARMUP_STEPS):  # only the last step counts, since the first one compiles
        run.run_step(is_counted=k == NUM_WARMUP_STEPS - 1)
    return (
        replace(stop_rule, max_iterations=max(1, int(MAX_ROUND_SECONDS / 4.0 / run.seconds_per_iteration)))
        if run.seconds > MAX_ROUND_SECONDS
        else stop_rule
    )


def _compute_min_seconds(scene: Scene) -> float:
    """Return the smallest time for the arithmetic of all non-spring energies [s].

    Each energy is evaluated once.
    """
    n = scene.system.num_vertices
    work = [_count_energy_work(energy, n) for energy in scene.system.energies if not isinstance(energy, Springs)]
    size, flops = sum(one.memory_bytes for one in work), sum(one.flops for one in work)
    if not size:
        return 0.0
    x, A = np.ones(size // 8), np.ones((_MATRIX_SIZE, _MATRIX_SIZE))
    return max(
        _measure_min_wall_seconds(lambda: x.dot(x)),
        flops / (2.0 * _MATRIX_SIZE**3) * _measure_min_wall_seconds(lambda: A @ A),
    )


def _measure_min_wall_seconds(work: Callable[[], object]) -> float:
    """Return the smallest of several wall times of a function [s]."""
    best = np.inf
    for _ in range(_NUM_REPEATS):
        began = perf_counter()
        work()
        best = min(best, perf_counter() - began)
    return best


class _EnergyWork(NamedTuple):
    """Bytes that an energy reads, and flops of its linear operations."""

    memory_bytes: int = 0
    flops: int = 0


def _count_energy_work(energy: Any, n: int) -> _EnergyWork:
    """Count the work of an energy's elements, or of its entries of Q.

    No work is counted for other energies, whose data are known only within a step.
    """
    if hasattr(energy, "elements"):
        return _EnergyWork(sum(x.nbytes for x in energy.elements), 12 * energy.elements.vertices.size)
    if isinstance(energy, ProjectiveEnergy):
        share = csr_array(energy.stiffness_matrix(n))
        return _EnergyWork(share.data.nbytes + share.indices.nbytes, 6 * share.nnz)
    return _EnergyWork()
