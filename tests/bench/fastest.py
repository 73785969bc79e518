"""Measure the time of a method relative to that of the fastest other method, by step snapshot and accuracy.

    ratio = median(t) / min_m median(t_m)     medians over the rounds, minimum over the other methods m

    python -m tests.bench.fastest [CONFIG] [--solver hybrid] [--only WORDS] [--rounds 15] [--measure error | own-gap]

The steps, the initial guesses and the methods are those of an accuracy config. An accuracy is an upper bound of one of
these measures, where g is the objective:

    gap      (g - g*)/(g0 - g*), relative to the lowest known minimum
    error    largest distance of a vertex from its position in that minimum, over the same distance at the step's start
    own-gap  gap relative to the certified minimum in whose basin the method itself ends

Minima are known from the search of references and, in `results`, from earlier runs of `springbench accuracy` with the
config, which certify the ends of all its methods. The published ratios, except of `configs/stiff.yaml`, follow such a
run. Where a step has several minima, which one a method reaches is chance; `own-gap` then measures how fast it
converges to its own, and `excess` how much higher that is than the lowest known, as a gap. The basin is that of
Newton's method from the end of the method after at most 3,000 iterations. A method that ends in the basin of no
certified minimum reaches no accuracy.

A method reaches an accuracy with its first iterate that satisfies it. A first pass evaluates all iterates. The methods
that may be the fastest are then timed interleaved in one process, for several rounds, by the processor time of the
thread. What is timed is a solve with the number of iterations up to that iterate. A timed solve follows an untimed one
of the same method: the caches then hold its data, as after the previous step of a simulation. The interval is a
bootstrap interval: it contains 95 % of the ratios of resampled rounds. The mark > denotes a ratio whose interval
exceeds the first of LIMITS in a step that takes at least MIN_COUNTED_SECONDS; `inf` denotes an accuracy that the method
does not reach. `configs/fastest.yaml` has other steps than `configs/accuracy.yaml`. The steps of `configs/unseen.yaml`
were not used to choose any part of a solver.
"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
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
from springbench.harness.reference.certified_minimum import refine_minimum
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions, PreparedSolver, StepProblem, StopRule, Unsupported
from springbench.solvers.registry import SOLVER_TABLE, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

ROOT = Path(__file__).resolve().parents[2]
TARGETS = {"gap": (1e-3, 1e-4, 1e-6), "error": (1e-3, 1e-6), "own-gap": (1e-3, 1e-4, 1e-6)}
LIMITS = (1.25, 1.6)
"""Ratios for which the number of accuracies within them is printed."""
MIN_COUNTED_SECONDS = 2e-4
"""Time of the fastest method [s], above which an accuracy is included in these numbers."""
MAX_FIRST_PASS_RATIO = 3.0
"""A method is timed if its first-pass time is within this multiple of the least of the other methods, for at least one
accuracy."""
MAX_REPEATED_GROWTH = 1.5
"""A first pass that exceeds its time is repeated if it has more than this multiple of the iterates of the one before:
kernels are compiled at their first use, and may take all the time of a pass."""
CONVERGED = StopRule(3000, rtol=1e-9)
"""End of the solve that finds the basin in which a method ends."""
NUM_RESAMPLES, CONFIDENCE = 2000, 0.95


class CandidateSolve(NamedTuple):
    """A method that is prepared for a step, and its first pass.

    name: of the solver; num_iterations, seconds: needed to reach each accuracy, by accuracy; without those that the
    method does not reach; own_minimum: objective of its own minimum [J], NaN unless it is measured and certified.
    """

    name: str
    prepared: PreparedSolver
    num_iterations: dict[float, int]
    seconds: dict[float, float]
    own_minimum: float = np.nan


@dataclass(frozen=True, slots=True)
class TimeRatio:
    """Result for one accuracy of a step.

    Attributes:
        step: title of the step.
        target: accuracy.
        fastest: the fastest other method.
        seconds: its time [s].
        ratio, low, high: ratio and the ends of its interval.
        excess: height of the method's minimum above the lowest known, relative to the decrease in the step; NaN if it
            is not measured.
    """

    step: str
    target: float
    fastest: str
    seconds: float
    ratio: float
    low: float
    high: float
    excess: float = np.nan

    @property
    def is_counted(self) -> bool:
        """Whether the fastest method takes more than MIN_COUNTED_SECONDS."""
        return self.seconds > MIN_COUNTED_SECONDS


def load_steps(config: Path, only: str) -> Iterator[tuple[SnapshotEvaluation, list[CurveSpec]]]:
    """Yield each step snapshot of a config once, with the specifications of the methods that solve it.

    only: words that the title and the snapshot's name contain.
    """
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


def build_measure(step: SnapshotEvaluation, problem: StepProblem, measure: str) -> Callable[[Positions], float]:
    """Return the function that computes the gap or the error of positions."""
    lowest, system = step.known_minima.lowest_minimum, problem.system
    if measure == "error":
        start = compute_vertex_distances(system, problem.current_positions, lowest.positions)[0]
        return lambda p: compute_vertex_distances(system, p, lowest.positions)[0] / start
    return build_gap(problem, lowest.objective)


def build_gap(problem: StepProblem, lowest: float) -> Callable[[Positions], float]:
    """Return the function that computes the gap of positions relative to a minimum with this objective [J]."""
    scale = problem.value(problem.current_positions) - lowest
    return lambda p: (problem.value(p) - lowest) / scale


def find_own_minimum(prepared: PreparedSolver, problem: StepProblem) -> float:
    """Return the objective [J] of the certified minimum in whose basin a method ends, NaN if it is none.

    Basins are those of Newton's method.
    """
    found = refine_minimum(problem, prepared.solve(problem, CONVERGED).positions, NewtonSolver())
    return found.objective if found.is_certified else np.nan


def build_candidate(
    spec: CurveSpec,
    problem: StepProblem,
    compute_measure: Callable[[Positions], float] | None,
    targets: Sequence[float],
) -> CandidateSolve | None:
    """Run the first pass of a method until it reaches all accuracies; return None if the scene is unsupported.

    Args:
        spec: the method and its limits.
        problem: the step.
        compute_measure: measure of an iterate; None for the gap relative to the method's own minimum.
        targets: accuracies.
    """
    try:
        prepared = load_target(SOLVER_TABLE[spec.solver.name])(**spec.solver.parameters).prepare(problem.system)
        next(prepared.iterates(problem))  # compiles
    except Unsupported:
        return None
    own_minimum = find_own_minimum(prepared, problem) if compute_measure is None else np.nan
    compute_measure = compute_measure or build_gap(problem, own_minimum)
    limits, num_before = (spec.max_iterations, spec.measurement.time_limit), 0
    while True:
        found, num_done, is_in_time = find_first_iterates(prepared, problem, compute_measure, targets, *limits)
        if is_in_time or num_done <= MAX_REPEATED_GROWTH * num_before:
            break
        num_before = num_done  # a kernel that was compiled may have taken the time
    numbers, seconds = ({target: pair[k] for target, pair in found.items()} for k in range(2))
    return CandidateSolve(spec.solver.name, prepared, numbers, seconds, own_minimum)


def find_first_iterates(
    prepared: PreparedSolver,
    problem: StepProblem,
    compute_measure: Callable[[Positions], float],
    targets: Sequence[float],
    max_iterations: int,
    time_limit: float,
) -> tuple[dict[float, tuple[int, float]], int, bool]:
    """Find the first iterates that satisfy the accuracies.

    Args:
        prepared: the method.
        problem: the step.
        compute_measure: measure of an iterate.
        targets: accuracies.
        max_iterations: maximum number of iterations.
        time_limit: limit of the processor time [s].

    Returns:
        Number of the iterate and processor time [s] by accuracy, number of iterates, and whether the time limit was not
        exceeded.
    """
    found, spent, number = dict[float, tuple[int, float]](), 0.0, 0
    iterates = prepared.iterates(problem)
    for number in range(1, max_iterations + 1):
        began = thread_time()
        p = next(iterates)
        spent += thread_time() - began
        remaining = compute_measure(p)
        found |= {target: (number, spent) for target in targets if remaining <= target and target not in found}
        if len(found) == len(targets) or spent > time_limit or not np.isfinite(remaining):
            break
    return found, number, spent <= time_limit


def measure_solve_seconds(prepared: PreparedSolver, problem: StepProblem, num_iterations: int) -> float:
    """Measure the thread's processor time [s] of a solve with this number of iterations."""
    stop = StopRule(num_iterations)
    gc.disable()  # otherwise the time of a garbage collection would be attributed to the solver
    try:
        began = thread_time()
        prepared.solve(problem, stop)
        return thread_time() - began
    finally:
        gc.enable()


def measure_interleaved(
    candidates: Sequence[CandidateSolve], problem: StepProblem, rounds: int
) -> dict[str, dict[float, NDArray[np.float64]]]:
    """Measure the times (rounds,) [s] to each accuracy by each method; the order of methods alternates by round."""
    times = {one.name: {target: list[float]() for target in one.num_iterations} for one in candidates}
    for round_number in range(-1, rounds):  # the first round is a warm-up
        for one in candidates if round_number % 2 else candidates[::-1]:
            numbers = sorted(set(one.num_iterations.values()))
            measure_solve_seconds(one.prepared, problem, numbers[-1])  # fills the caches
            by_number = {number: measure_solve_seconds(one.prepared, problem, number) for number in numbers}
            for target, number in one.num_iterations.items() if round_number >= 0 else ():
                times[one.name][target].append(by_number[number])
    return {
        name: {target: np.array(values) for target, values in by_target.items()} for name, by_target in times.items()
    }


def compute_ratio(
    step: str, target: float, name: str, times: dict[str, dict[float, NDArray[np.float64]]], draws: NDArray[np.int64]
) -> TimeRatio | None:
    """Compute the ratio of one method, and its bootstrap interval.

    Return an infinite ratio if only the other methods reach the accuracy, and None if none of the others does.

    step: title of the step; times: of each method by accuracy (rounds,) [s]; draws: indices of resampled rounds
    (resamples, rounds).
    """
    others = {other: by_target[target] for other, by_target in times.items() if other != name and target in by_target}
    if not others:
        return None
    fastest = min(others, key=lambda other: np.median(others[other]))
    least = float(np.median(others[fastest]))
    if target not in times[name]:
        return TimeRatio(step, target, fastest, least, np.inf, np.inf, np.inf)
    seconds = times[name][target]
    best = np.min([np.median(other[draws], axis=-1) for other in others.values()], axis=0)
    resampled = np.median(seconds[draws], axis=-1) / best
    low, high = np.quantile(resampled, ((1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2))
    return TimeRatio(step, target, fastest, least, float(np.median(seconds)) / least, float(low), float(high))


def measure_step(
    step: SnapshotEvaluation, specs: Sequence[CurveSpec], name: str, rounds: int, measure: str
) -> Iterator[TimeRatio]:
    """Yield the ratios of a method on one step, from each initial guess and to each accuracy."""
    rng, targets = np.random.default_rng(0), TARGETS[measure]
    draws = rng.integers(rounds, size=(NUM_RESAMPLES, rounds))
    for guess in specs[0].initial_guesses:
        problem = step.step_snapshot.build_problem(guess)
        compute_measure = None if measure == "own-gap" else build_measure(step, problem, measure)
        candidates = [found for spec in specs if (found := build_candidate(spec, problem, compute_measure, targets))]
        others = [one for one in candidates if one.name != name]
        least = {t: min((one.seconds[t] for one in others if t in one.seconds), default=np.inf) for t in targets}
        timed = [
            one
            for one in candidates
            if one.num_iterations
            and (one.name == name or any(s <= MAX_FIRST_PASS_RATIO * least[t] for t, s in one.seconds.items()))
        ]
        times = {name: {}} | measure_interleaved(timed, problem, rounds)
        title = f"{step.case.title} {step.snapshot_name} {guess}"
        excess = np.nan
        if compute_measure is None:
            lowest, start = step.known_minima.lowest_minimum.objective, problem.value(problem.current_positions)
            own = next((one.own_minimum for one in candidates if one.name == name), np.nan)
            excess = (own - lowest) / (start - lowest)
        found = (compute_ratio(title, target, name, times, draws) for target in targets)
        yield from (replace(one, excess=excess) for one in found if one is not None)


def format_ratio(one: TimeRatio) -> str:
    """Format a table cell: ratio, interval, fastest other method and its milliseconds."""
    is_above_limit = one.is_counted and one.high > LIMITS[0]
    mark = ">" if is_above_limit else ""
    return f"{mark}{one.ratio:.2f} [{one.low:.2f}, {one.high:.2f}] {one.fastest} {1e3 * one.seconds:.2f}"


def format_lines(found: Iterable[TimeRatio], targets: Sequence[float]) -> Iterator[str]:
    """Yield a line for each initial guess of a step, with a column for each accuracy."""
    rows: dict[str, dict[float, str]] = {}
    for one in found:
        rows.setdefault(one.step, {})[one.target] = format_ratio(one)
    for step, cells in rows.items():
        yield align_columns(step, [cells.get(target, "") for target in targets])


def align_columns(first: str, cells: Sequence[str]) -> str:
    """Return a line with columns of fixed width."""
    return f"{first:<40}" + "".join(f"{cell:<38}" for cell in cells).rstrip()


def main() -> None:
    """Print the ratio, its interval, the fastest other method and its milliseconds for each step."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("config", nargs="?", type=Path, default=ROOT / "configs" / "accuracy.yaml")
    parser.add_argument("--solver", default="hybrid", help="solver whose ratios are measured")
    parser.add_argument("--only", default="", help="words that the step's title contains")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--measure", choices=list(TARGETS), default="gap", help="quantity that an accuracy bounds")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    given = parser.parse_args()
    begin, found, targets = describe_provenance(), list[TimeRatio](), TARGETS[given.measure]
    print(align_columns(f"step, first guess; {given.measure}", [f"{target:g}" for target in targets]))
    with limit_threads(1):
        for step, specs in load_steps(given.config, given.only):
            of_step = list(measure_step(step, specs, given.solver, given.rounds, given.measure))
            print(*format_lines(of_step, targets), sep="\n", flush=True)
            found += of_step
    counted = [one for one in found if one.is_counted]
    for limit in LIMITS:
        within = sum(one.ratio <= limit for one in counted)
        least = f"{1e3 * MIN_COUNTED_SECONDS:g} ms"
        print(f"{within} of {len(counted)} accuracies that take above {least} are within {limit:g}")
    print(f"{sum(one.ratio == np.inf for one in found)} of {len(found)} accuracies are not reached")
    rows = [
        {"solver": given.solver, "measure": given.measure, **asdict(one), "counts": one.is_counted} for one in found
    ]
    publish_rows(given.publish, given.config, rows, begin)


if __name__ == "__main__":
    main()
