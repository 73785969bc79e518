"""How many times as long as the fastest of all methods one of them takes, by frozen step and accuracy.

    ratio = q(t) / min_m q(t_m)     q the median over the rounds, m the other methods

    python -m tests.bench.fastest [CONFIG] [--solver hybrid] [--only WORDS] [--rounds 15] [--measure error]

The steps, the first guesses and the methods are those of an accuracy config. An accuracy is a gap,
(g - g*)/(g0 - g*), g* of the lowest minimum known, or an error, the largest distance of a vertex from its place in that
minimum over the largest there at the step's start, and is reached with the first iterate that has it. A first pass
grades all iterates; then all that may be the fastest take turns in one process, round after round, with a clock of the
thread's own processor time, and their results are not used. The interval contains 95 % of the ratios of rounds that
were drawn with replacement. A ratio whose interval reaches above the first of LIMITS is marked by >, where the step
takes so long that it counts; `inf` is one that is not reached. `configs/fastest.yaml` has other steps than
`configs/accuracy.yaml`, and by those of `configs/unseen.yaml` nothing of any solver was chosen.
"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from time import thread_time
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.config.accuracy_config import CurveSpec
from springbench.harness.config.accuracy_loader import load_accuracy
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.accuracy.accuracy_units import open_reference_store
from springbench.harness.experiments.accuracy.snapshot_rows import SnapshotEvaluation
from springbench.harness.experiments.accuracy.step_scales import compute_vertex_distances
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, Unsupported
from springbench.solvers.registry import SOLVER_TABLE, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

ROOT = Path(__file__).resolve().parents[2]
TARGETS = {"gap": (1e-3, 1e-4, 1e-6), "error": (1e-3, 1e-6)}
LIMITS = (1.25, 1.6)
"""Ratios of which the shares of accuracies within them are stated."""
COUNTS = 2e-4
"""Seconds of the fastest method's, below which a step counts for nothing."""
HOPELESS = 3.0
"""Times the least time of the first pass, from which on a method takes no turns."""
DRAWS, SHARE = 2000, 0.95


class CandidateSolve(NamedTuple):
    """A method on a step: its name, what solves, after how many iterations it is at which gap, and seconds of that."""

    name: str
    prepared: PreparedSolver
    needs: dict[float, int]
    seconds: dict[float, float]


@dataclass(frozen=True, slots=True)
class Ratio:
    """One accuracy of a step: the fastest method's name and time [s], the ratio to it, and its interval."""

    step: str
    target: float
    fastest: str
    seconds: float
    ratio: float
    low: float
    high: float

    @property
    def counts(self) -> bool:
        """Whether the step takes so long."""
        return self.seconds > COUNTS


def steps(config: Path, only: str) -> Iterator[tuple[SnapshotEvaluation, list[CurveSpec]]]:
    """The frozen steps of a config whose words are among their names, each once, and who is to solve them."""
    store = open_reference_store(ROOT / "results")
    options: dict[tuple[str, str, str | int], list[CurveSpec]] = {}
    for spec in load_accuracy(config).curves:
        options.setdefault((spec.case.title, spec.case.integrator, spec.snapshot), []).append(spec)
    known: set[str] = set()
    for (title, _, moment), specs in options.items():
        if all(word in f"{title} {moment}" for word in only.split()):
            step = SnapshotEvaluation.load_snapshot(specs[0].case, moment, store)
            if step.step_snapshot.digest not in known and step.known_minima.minima:
                known.add(step.step_snapshot.digest)
                yield step, specs


def grading(step: SnapshotEvaluation, problem: StepProblem, measure: str) -> Callable[[Positions], float]:
    """Function that returns the gap or the error of positions."""
    lowest, system = step.known_minima.lowest_minimum, problem.system
    if measure == "error":
        start = compute_vertex_distances(system, problem.current_positions, lowest.positions)[0]
        return lambda p: compute_vertex_distances(system, p, lowest.positions)[0] / start
    scale = problem.value(problem.current_positions) - lowest.objective
    return lambda p: (problem.value(p) - lowest.objective) / scale


def build_candidate(
    spec: CurveSpec, problem: StepProblem, graded: Callable[[Positions], float], targets: Sequence[float]
) -> CandidateSolve | None:
    """The first pass of a method, up to the last of the accuracies; None where it takes no such scene."""
    try:
        prepared = load_target(SOLVER_TABLE[spec.solver.name])(**spec.solver.parameters).prepare(problem.system)
        next(prepared.iterates(problem))  # compiles
    except Unsupported:
        return None
    needs, seconds = dict[float, int](), dict[float, float]()
    iterates, spent = prepared.iterates(problem), 0.0
    for number in range(1, spec.max_iterations + 1):
        began = thread_time()
        p = next(iterates)
        spent += thread_time() - began
        left = graded(p)
        for target in targets:
            if left <= target and target not in needs:
                needs[target], seconds[target] = number, spent
        if len(needs) == len(targets) or spent > spec.measurement.time_limit or not np.isfinite(left):
            break
    return CandidateSolve(spec.solver.name, prepared, needs, seconds)


def measure_iterate_seconds(prepared: PreparedSolver, problem: StepProblem, stamps: Sequence[int]) -> list[float]:
    """Seconds of the thread's processor time to each of these iterates, ascending."""
    wanted, found = set(stamps), dict[int, float]()
    gc.disable()  # a collection in the middle would be counted as the solver's
    try:
        began = thread_time()
        for number, _ in enumerate(islice(prepared.iterates(problem), stamps[-1]), 1):
            if number in wanted:
                found[number] = thread_time() - began
    finally:
        gc.enable()
    return [found[number] for number in stamps]


def measure_interleaved(
    racers: Sequence[CandidateSolve], problem: StepProblem, rounds: int
) -> dict[str, dict[float, NDArray[np.float64]]]:
    """Seconds (rounds,) to each accuracy, of each method, interleaved, in one order and then in the other."""
    times: dict[str, dict[float, list[float]]] = {one.name: {target: [] for target in one.needs} for one in racers}
    for turn in range(-1, rounds):  # the first one warms up
        for one in racers if turn % 2 else racers[::-1]:
            stamps = sorted(set(one.needs.values()))
            by_stamp = dict(zip(stamps, measure_iterate_seconds(one.prepared, problem, stamps), strict=True))
            for target, number in one.needs.items() if turn >= 0 else ():
                times[one.name][target].append(by_stamp[number])
    return {name: {target: np.array(values) for target, values in of.items()} for name, of in times.items()}


def ratio(
    step: str, target: float, name: str, times: dict[str, dict[float, NDArray[np.float64]]], draws: NDArray[np.int64]
) -> Ratio | None:
    """Of one method, None where it and all others miss the accuracy; infinite where it does alone."""
    others = {other: of[target] for other, of in times.items() if other != name and target in of}
    if not others:
        return None
    fastest = min(others, key=lambda other: np.median(others[other]))
    least = float(np.median(others[fastest]))
    if target not in times[name]:
        return Ratio(step, target, fastest, least, np.inf, np.inf, np.inf)
    mine = times[name][target]
    best = np.min([np.median(of[draws], axis=-1) for of in others.values()], axis=0)
    low, high = np.quantile(np.median(mine[draws], axis=-1) / best, ((1 - SHARE) / 2, (1 + SHARE) / 2))
    return Ratio(step, target, fastest, least, float(np.median(mine)) / least, float(low), float(high))


def ratios(
    step: SnapshotEvaluation, specs: Sequence[CurveSpec], name: str, rounds: int, measure: str
) -> Iterator[Ratio]:
    """Of one step, from each first guess."""
    rng, targets = np.random.default_rng(0), TARGETS[measure]
    draws = rng.integers(rounds, size=(DRAWS, rounds))
    for guess in specs[0].initial_guesses:
        problem = step.step_snapshot.build_problem(guess)
        graded = grading(step, problem, measure)
        racers = [found for spec in specs if (found := build_candidate(spec, problem, graded, targets))]
        least = {t: min((one.seconds[t] for one in racers if t in one.seconds), default=np.inf) for t in targets}
        near = [
            one
            for one in racers
            if one.needs and (one.name == name or any(s <= HOPELESS * least[t] for t, s in one.seconds.items()))
        ]
        times = {name: {}} | measure_interleaved(near, problem, rounds)
        words = f"{step.case.title} {step.snapshot_name} {guess}"
        found = (ratio(words, target, name, times, draws) for target in targets)
        yield from (one for one in found if one is not None)


def cell(one: Ratio) -> str:
    """Its words."""
    over = one.counts and one.high > LIMITS[0]
    return f"{'>' if over else ''}{one.ratio:.2f} [{one.low:.2f}, {one.high:.2f}] {one.fastest} {1e3 * one.seconds:.2f}"


def lines(found: Iterable[Ratio], targets: Sequence[float]) -> Iterator[str]:
    """One for each first guess of a step."""
    rows: dict[str, dict[float, str]] = {}
    for one in found:
        rows.setdefault(one.step, {})[one.target] = cell(one)
    for step, cells in rows.items():
        yield row(step, [cells.get(target, "") for target in targets])


def row(first: str, cells: Sequence[str]) -> str:
    """In columns."""
    return f"{first:<40}" + "".join(f"{cell:<38}" for cell in cells).rstrip()


def main() -> None:
    """Print ratio, interval, the fastest other method and its milliseconds, step by step."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("config", nargs="?", type=Path, default=ROOT / "configs" / "accuracy.yaml")
    parser.add_argument("--solver", default="hybrid", help="whose ratios")
    parser.add_argument("--only", default="", help="words that the step's name must have")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--measure", choices=list(TARGETS), default="gap", help="what an accuracy is of")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    given = parser.parse_args()
    begin, found, targets = describe_provenance(), list[Ratio](), TARGETS[given.measure]
    print(row(f"step, first guess; {given.measure}", [f"{target:g}" for target in targets]))
    with limit_threads(1):
        for step, specs in steps(given.config, given.only):
            of_step = list(ratios(step, specs, given.solver, given.rounds, given.measure))
            print(*lines(of_step, targets), sep="\n", flush=True)
            found += of_step
    counted = [one for one in found if one.counts]
    for limit in LIMITS:
        within = sum(one.ratio <= limit for one in counted)
        print(f"{within} of {len(counted)} accuracies that take above {1e3 * COUNTS:g} ms are within {limit:g}")
    print(f"{sum(one.ratio == np.inf for one in found)} of {len(found)} accuracies are not reached")
    rows = [{"solver": given.solver, "measure": given.measure, **asdict(one), "counts": one.counts} for one in found]
    publish_rows(given.publish, given.config, f"python -m tests.bench.fastest {given.config}", rows, begin)


if __name__ == "__main__":
    main()
