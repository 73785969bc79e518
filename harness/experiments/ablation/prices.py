"""Measure the per-iteration overhead of each effect with each solver.

    price = median over rounds of (CPU time per iteration with the effect) / (CPU time per iteration without it)

The baseline scene has only the effects that are declared `plain`. Both scenes are simulated interleaved, step by step,
to the requested tolerance, so that a drift of the machine affects both alike. Rounds end once the interval of the ratio
is narrower than CLOSE, or at the largest number of rounds. A round that has taken ENOUGH ends
with the next counted step, and then LEAST rounds suffice. Where a single step takes that long, the number of
iterations per step is reduced. So the slowest solvers take minutes as well.

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

from harness.base.errors import InputError
from harness.base.statistics import Interval, ratio
from harness.scenes.bind import Scene, build
from harness.scenes.effects.base import Effect
from harness.scenes.spec import SceneSpec
from harness.simulation.algebraic import Stop
from harness.simulation.step import Step, prepare, simulate
from solvers.energies.springs import Springs
from solvers.problem import NotPositiveDefinite, Prepared, ProjectiveEnergy, Solver, Unsupported

ALL = "all"
"""Name of all effects together."""
CLOSE, LEAST = 0.03, 3
"""Relative width of the interval at which rounds end; number of rounds that an interval needs."""
WARM = 2
"""Number of steps before those that count."""
ENOUGH = 2.0
"""CPU time of both scenes' steps after which a round has only one more counted step [s]."""
_READS = 20
_SIDE = 256
"""Size of the matrices whose product determines the peak number of flops per second."""


Ready = tuple[Scene, Prepared]
"""Scene, and the solver prepared for it."""


class Price(NamedTuple):
    """Per-iteration overhead of an effect.

    Attributes:
        effect: kind of the effect.
        price: CPU time per iteration with the effect, divided by that without, with its interval.
        seconds: CPU time per iteration with the effect [s].
        bound: lower bound of the ratio, from the effect's own bytes and flops.
        rounds: number of rounds.
        iterations: iteration limit of a step.
        refused: why there is no measurement; empty if there is one.
    """

    effect: str
    price: Interval = Interval(np.nan, np.nan, np.nan)
    seconds: float = np.nan
    bound: float = np.nan
    rounds: int = 0
    iterations: int = 0
    refused: str = ""


@dataclass(eq=False)
class _Run:
    """Running simulation of a scene by one solver.

    `seconds` and `iterations` are those of the counted steps, `spent` those of all steps [s].
    """

    steps: Iterator[Step]
    seconds: float = 0.0
    iterations: int = 0
    spent: float = 0.0

    def step(self, *, counts: bool) -> None:
        """Compute the next step; it is included in `seconds` and `iterations` if `counts`."""
        began = thread_time()
        done = next(self.steps)
        took = thread_time() - began
        self.spent += took
        if counts:
            self.seconds += took
            self.iterations += done.iterations

    @property
    def each(self) -> float:
        """CPU time per iteration [s]."""
        return self.seconds / max(1, self.iterations)


def priced(scene: SceneSpec) -> list[str]:
    """Return the kinds of effects to measure, then ALL. Raises InputError if there are none."""
    kinds = list(dict.fromkeys(effect.kind for effect in scene.effects if not _plain(effect)))
    if not kinds:
        listed = ", ".join(dict.fromkeys(effect.kind for effect in scene.effects))
        raise InputError(f"{scene.path}: has no effect that has a price; those without one: {listed or 'none'}")
    return [*kinds, ALL]


def only(scene: SceneSpec, *kinds: str) -> SceneSpec:
    """Return the scene with these effects and the baseline effects only; ALL selects all."""
    if ALL in kinds:
        return scene
    kept = [i for i, e in enumerate(scene.effects) if e.kind in kinds or _plain(e)]
    return scene.model_copy(update=scene.of_effects(kept))


def _plain(effect: Effect) -> bool:
    """Return whether an effect is declared part of the baseline."""
    return bool(getattr(effect, "plain", False))


def prices(scene: SceneSpec, size: int, solver: Solver, stop: Stop, *, frames: int, rounds: int) -> Iterator[Price]:
    """Measure the overhead of each effect with one solver; unsupported effects yield a reason.

    Args:
        scene: the scene.
        size: mesh size.
        solver: the solver.
        stop: stop rule of a step.
        frames: number of counted steps in a round.
        rounds: largest number of rounds.
    """
    plain = None
    for effect in priced(scene):
        try:
            if plain is None:
                plain = ready(scene, size, solver)
                stop = _affordable(plain, stop)
            yield price(effect, ready(scene, size, solver, effect), plain, stop, frames=frames, rounds=rounds)
        except (InputError, NotPositiveDefinite, Unsupported) as error:
            yield Price(effect, refused=str(error))


def ready(scene: SceneSpec, size: int, solver: Solver, *effects: str) -> Ready:
    """Build the scene with these effects and the baseline effects, and prepare the solver.

    Raises:
        InputError: the scene cannot be built.
        NotPositiveDefinite: the system matrix is not positive definite.
        Unsupported: the solver does not support an effect.
    """
    made = build(only(scene, *effects), size)
    return made, prepare(made, solver)


def price(effect: str, one: Ready, plain: Ready, stop: Stop, *, frames: int, rounds: int) -> Price:
    """Measure the overhead of an effect from scenes with and without it.

    Args:
        effect: kind of the effect.
        one: scene with the effect.
        plain: scene without it.
        stop: stop rule of a step.
        frames: number of counted steps in a round.
        rounds: largest number of rounds.
    """
    pairs: list[tuple[float, float]] = []
    found = Interval(np.nan, np.nan, np.nan)
    while len(pairs) < rounds:
        runs = [_Run(iter(simulate(*it, stop, first_guess="current", frames=WARM + frames))) for it in (one, plain)]
        enough = False
        for k in range(WARM + frames):
            last = enough
            for run in runs[:: 1 if len(pairs) % 2 else -1]:
                run.step(counts=last or k >= WARM)
            enough = sum(run.spent for run in runs) > ENOUGH
            if last or (enough and k >= WARM):
                break
        pairs.append((runs[0].each, runs[1].each))
        found = ratio(*np.array(pairs).T)
        if len(pairs) >= LEAST and (enough or found.high - found.low <= CLOSE * found.middle):
            break
    each, without = np.array(pairs).min(axis=0)
    return Price(effect, found, float(each), 1.0 + _least(one[0]) / without, len(pairs), stop.iterations)


def _affordable(plain: Ready, stop: Stop) -> Stop:
    """Return the stop rule, with fewer iterations if a step takes longer than ENOUGH.

    The reduced number of iterations takes a quarter of that time.
    """
    run = _Run(iter(simulate(*plain, stop, first_guess="current", frames=WARM)))
    for k in range(WARM):  # what the first compiles does not count
        run.step(counts=k == WARM - 1)
    return replace(stop, iterations=max(1, int(ENOUGH / 4.0 / run.each))) if run.seconds > ENOUGH else stop


def _least(scene: Scene) -> float:
    """Return the smallest time for the arithmetic of all non-spring energies [s].

    Each energy is evaluated once.
    """
    n = scene.system.vertices
    work = [_work(energy, n) for energy in scene.system.energies if not isinstance(energy, Springs)]
    size, flops = sum(one.bytes for one in work), sum(one.flops for one in work)
    if not size:
        return 0.0
    x, A = np.ones(size // 8), np.ones((_SIDE, _SIDE))
    return max(_fastest(lambda: x.dot(x)), flops / (2.0 * _SIDE**3) * _fastest(lambda: A @ A))


def _fastest(work: Callable[[], object]) -> float:
    """Return the smallest of several wall times of a function [s]."""
    best = np.inf
    for _ in range(_READS):
        began = perf_counter()
        work()
        best = min(best, perf_counter() - began)
    return best


class _Work(NamedTuple):
    """Bytes that an energy reads, and flops that are linear in them."""

    bytes: int = 0
    flops: int = 0


def _work(energy: Any, n: int) -> _Work:
    """Count the work of an energy's elements, or of its entries of Q.

    Data known only in steps is not counted.
    """
    if hasattr(energy, "elements"):
        return _Work(sum(x.nbytes for x in energy.elements), 12 * energy.elements.vertices.size)
    if isinstance(energy, ProjectiveEnergy):
        share = csr_array(energy.stiffness_matrix(n))
        return _Work(share.data.nbytes + share.indices.nbytes, 6 * share.nnz)
    return _Work()
