"""What an iteration takes with an effect, over one without: each effect by each solver.

    price = median over rounds of (CPU time an iteration of plain + effect) / (the same of plain)

The plain scene has the effects that say that they are `plain`. Both scenes go step by step in turns, each to
the tolerance that is asked for, so that a drift of the machine meets both alike. Rounds end once the price is known to
CLOSE, or after as many as are allowed. A round that has taken ENOUGH ends with the next step that counts, and then
LEAST rounds will do; where a single step takes that long, fewer iterations a step are done. So the slowest solvers take
minutes as well.

No iteration reads the effect's own numbers sooner than a dot product does, nor multiplies and adds them up sooner than
a product of matrices does: the longer one is the bound beside each price. Of an element that couples k vertices 12 k
flops count, those of A p and of A'f for three coordinates, and none of what happens in between.
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
"""The name of all effects together."""
CLOSE, LEAST = 0.03, 3
"""Of a price, the width of its interval at which rounds end; and rounds that an interval needs."""
WARM = 2
"""Steps before those that count."""
ENOUGH = 2.0
"""Seconds of CPU time, of both scenes' steps, after which a round has no more steps but one that counts."""
_READS = 20
_SIDE = 256
"""Of matrices whose product tells how many flops a second there are at the most."""


Ready = tuple[Scene, Prepared]
"""A scene, and what a solver prepared for it."""


class Price(NamedTuple):
    """Of an effect: the ratio, and seconds of CPU time an iteration with the effect; bound: the least
    ratio that the effect's own bytes and flops allow; iterations: the limit of a step; refused: why there is none of
    these, in words."""

    effect: str
    price: Interval = Interval(np.nan, np.nan, np.nan)
    seconds: float = np.nan
    bound: float = np.nan
    rounds: int = 0
    iterations: int = 0
    refused: str = ""


@dataclass(eq=False)
class _Run:
    """A scene on its way by one solver: seconds of the steps that count, and their iterations; spent: of all [s]."""

    steps: Iterator[Step]
    seconds: float = 0.0
    iterations: int = 0
    spent: float = 0.0

    def step(self, *, counts: bool) -> None:
        """One step more."""
        began = thread_time()
        done = next(self.steps)
        took = thread_time() - began
        self.spent += took
        if counts:
            self.seconds += took
            self.iterations += done.iterations

    @property
    def each(self) -> float:
        """Seconds an iteration."""
        return self.seconds / max(1, self.iterations)


def priced(scene: SceneSpec) -> list[str]:
    """The kinds of effects that have a price, and all of them together; raises InputError where there is none."""
    kinds = list(dict.fromkeys(effect.kind for effect in scene.effects if not _plain(effect)))
    if not kinds:
        listed = ", ".join(dict.fromkeys(effect.kind for effect in scene.effects))
        raise InputError(f"{scene.path}: has no effect that has a price; those without one: {listed or 'none'}")
    return [*kinds, ALL]


def only(scene: SceneSpec, *kinds: str) -> SceneSpec:
    """The scene with these effects alone, and the plain ones; with all of them where they are ALL."""
    if ALL in kinds:
        return scene
    kept = [i for i, e in enumerate(scene.effects) if e.kind in kinds or _plain(e)]
    return scene.model_copy(update=scene.of_effects(kept))


def _plain(effect: Effect) -> bool:
    """Whether it says that it has no price."""
    return bool(getattr(effect, "plain", False))


def prices(scene: SceneSpec, size: int, solver: Solver, stop: Stop, *, frames: int, rounds: int) -> Iterator[Price]:
    """The price of each effect by a solver; one that it refuses has none. frames: that count in a round."""
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
    """The scene with these effects and the plain ones; raises InputError, NotPositiveDefinite and Unsupported."""
    made = build(only(scene, *effects), size)
    return made, prepare(made, solver)


def price(effect: str, one: Ready, plain: Ready, stop: Stop, *, frames: int, rounds: int) -> Price:
    """The price of an effect, from scenes with and without it. frames: that count in a round."""
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
    """The rule; where a step takes longer than ENOUGH, with as many iterations as take a quarter of it."""
    run = _Run(iter(simulate(*plain, stop, first_guess="current", frames=WARM)))
    for k in range(WARM):  # what the first compiles does not count
        run.step(counts=k == WARM - 1)
    return replace(stop, iterations=max(1, int(ENOUGH / 4.0 / run.each))) if run.seconds > ENOUGH else stop


def _least(scene: Scene) -> float:
    """The least time [s] that the arithmetic of all energies that are not springs takes, once each."""
    n = scene.system.vertices
    work = [_work(energy, n) for energy in scene.system.energies if not isinstance(energy, Springs)]
    size, flops = sum(one.bytes for one in work), sum(one.flops for one in work)
    if not size:
        return 0.0
    x, A = np.ones(size // 8), np.ones((_SIDE, _SIDE))
    return max(_fastest(lambda: x.dot(x)), flops / (2.0 * _SIDE**3) * _fastest(lambda: A @ A))


def _fastest(work: Callable[[], object]) -> float:
    """The least of some times [s] that it takes."""
    best = np.inf
    for _ in range(_READS):
        began = perf_counter()
        work()
        best = min(best, perf_counter() - began)
    return best


class _Work(NamedTuple):
    """What an energy reads of its own, and the flops of what is linear in it."""

    bytes: int = 0
    flops: int = 0


def _work(energy: Any, n: int) -> _Work:
    """Of its elements, or of its entries of Q; none of what is known in steps alone."""
    if hasattr(energy, "elements"):
        return _Work(sum(x.nbytes for x in energy.elements), 12 * energy.elements.vertices.size)
    if isinstance(energy, ProjectiveEnergy):
        share = csr_array(energy.stiffness_matrix(n))
        return _Work(share.data.nbytes + share.indices.nbytes, 6 * share.nnz)
    return _Work()
