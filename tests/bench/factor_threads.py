"""Measure the speedup of an iteration of Newton's method by a second thread, compared with MKL PARDISO.

    python -m tests.bench.factor_threads [--sizes 32 64 128 256 400] [--rounds 9]
        [--publish results/published/factor-threads]

An iteration consists of the gradient, the Hessian, its factorisation, the solve, and the change of the objective, on a
sheet that is stretched by 5 %, so that the Hessian is positive definite. PARDISO, an optional dependency (`pardiso`),
computes the numeric factorisation of that Hessian alone. Measurements of both programs with one and two threads
alternate. A pause separates the programs, so that waiting threads of one do not spin during the measurement of the
other. Untimed calls precede each measurement, since the threads of a program that has slept run on one core until the
system distributes them. The table has median wall times, and medians of the rounds' ratios with their quartiles. It
requires two idle cores.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from os import getloadavg
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

import numba
import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.sparse import bsr_array, csr_matrix, triu
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.harness.simulation.time_loop import build_initial_state, build_problem
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

from tests.bench.gates import build_sheet
from tests.bench.scripted_study import describe_provenance, publish_rows

SCENE = Path(__file__).parents[2] / "configs" / "scenes" / "hanging-cloth.yaml"

PAUSE = 0.3
"""Pause between the two programs [s]: waiting threads of Intel's runtime spin for 0.2 s."""

WARM_UP = 0.1
"""Duration of the untimed calls before a measurement [s], of at least one call."""


def build_newton_iteration(size: int) -> tuple[Callable[[], object], StepObjective, np.ndarray]:
    """Return an iteration on the sheet, its objective, and the positions (n, 3) [m] at which it begins."""
    scene = build_sheet(size)
    step = StepObjective(FixedObjective(scene.system), build_problem(scene, build_initial_state(scene), "previous"))
    p = step.apply_exact_pins(1.05 * scene.mesh.rest_positions)

    def iterate() -> object:
        d = step.hessian(p).factorise_and_solve(-step.gradient(p))
        assert d is not None, "the Hessian of a stretched sheet is positive definite"
        return step.objective_change(p, p + d)

    return iterate, step, p


def build_pardiso_factorisation(step: StepObjective, p: np.ndarray, threads: int) -> Callable[[], object] | None:
    """Return PARDISO's numeric factorisation of the Hessian with a number of threads; None without pypardiso.

    The symbolic factorisation is computed here, since it is valid for one number of threads.
    """
    try:
        from pypardiso import PyPardisoSolver  # pyright: ignore[reportMissingImports]  (an optional dependency)
    except ImportError:
        return None
    matrix = step.hessian(p).assemble_clamped()
    graph, n = matrix.graph, 3 * matrix.graph.shape[0]
    full = bsr_array((matrix.values, graph.indices, graph.indptr), shape=(n, n))
    upper = csr_matrix(triu(full.tocsr(), format="csr"))
    solver: Any = PyPardisoSolver(mtype=2)  # symmetric positive definite
    zero_rhs = np.zeros((n, 1))

    def run(phase: int) -> object:
        solver.libmkl.MKL_Set_Num_Threads(threads)
        solver.set_phase(phase)
        return solver._call_pardiso(upper, zero_rhs)

    run(11)  # symbolic factorisation
    return lambda: run(22)  # numeric factorisation


def _measure_seconds(work: Callable[[], object], repeats: int) -> float:
    begin = perf_counter()
    for _ in range(repeats):
        work()
    return (perf_counter() - begin) / repeats


def _warm_up(work: Callable[[], object]) -> None:
    end = perf_counter() + WARM_UP
    work()
    while perf_counter() < end:
        work()


def _measure_interleaved(programs: list[list[Callable[[], object]]], rounds: int) -> np.ndarray:
    """Measure wall times (rounds, works) [s] of the works of several programs.

    The order of the works alternates by round. Untimed calls precede each, and a pause follows each program.
    """
    seconds = np.empty((rounds, sum(map(len, programs))))
    for work in (work for works in programs for work in works):
        work()
    repeats = [max(1, int(0.02 / _measure_seconds(works[0], 1))) for works in programs]
    for k in range(rounds):
        first = 0
        for works, count in zip(programs, repeats, strict=True):
            for i in range(len(works))[:: 1 if k % 2 == 0 else -1]:
                _warm_up(works[i])
                seconds[k, first + i] = _measure_seconds(works[i], count)
            first += len(works)
            if len(programs) > 1:
                sleep(PAUSE)
    return seconds


def _compute_quartiles(name: str, ratios: np.ndarray) -> dict[str, float]:
    """Return the columns of the median and the quartiles of ratios."""
    low, middle, high = np.quantile(ratios, (0.25, 0.5, 0.75)).tolist()
    return {name: middle, f"{name}_low": low, f"{name}_high": high}


def measure_size(size: int, rounds: int) -> dict[str, float]:
    """Measure a mesh size: a row of median milliseconds, and of ratios with their quartiles.

    The columns of PARDISO are absent if it is not installed.
    """
    iterate, step, p = build_newton_iteration(size)

    def limit_iteration(threads: int) -> Callable[[], object]:
        return lambda: (numba.set_num_threads(threads), iterate())

    factorisations = [work for k in (1, 2) if (work := build_pardiso_factorisation(step, p, k))]
    programs = [[limit_iteration(1), limit_iteration(2)], *([factorisations] if factorisations else [])]
    seconds = _measure_interleaved(programs, rounds)
    one, two, *pardiso = np.median(seconds, axis=0).tolist()
    row = {"size": size, "one_thread_ms": 1e3 * one, "two_threads_ms": 1e3 * two}
    row |= _compute_quartiles("thread_ratio", seconds[:, 0] / seconds[:, 1])
    if pardiso:
        row |= {"pardiso_one_thread_ms": 1e3 * pardiso[0], "pardiso_two_threads_ms": 1e3 * pardiso[1]}
        row |= _compute_quartiles("pardiso_ratio", seconds[:, 3] / seconds[:, 1])
    return row


def _format_cells(row: dict[str, float]) -> list[str]:
    """Format the table cells of a row; a dash denotes an absent column."""

    def format_ratio(name: str) -> str:
        return f"{row[name]:.2f} ({row[f'{name}_low']:.2f} to {row[f'{name}_high']:.2f})" if name in row else "-"

    def format_time(name: str) -> str:
        return f"{row[name]:.2f}" if name in row else "-"

    return [
        f"{row['size']}",
        *(format_time(name) for name in ("one_thread_ms", "two_threads_ms")),
        format_ratio("thread_ratio"),
        *(format_time(name) for name in ("pardiso_one_thread_ms", "pardiso_two_threads_ms")),
        format_ratio("pardiso_ratio"),
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[32, 64, 128, 256, 400])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    given = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, float]]()
    print(f"{describe_machine().cpu}; load {getloadavg()[0]:.1f}; times in ms")
    columns = "size", "1 thread", "2 threads", "ratio", "PARDISO, 1", "PARDISO, 2", "PARDISO / ours, 2"
    table = Table(*columns, box=SIMPLE_HEAD)
    with limit_threads(2):
        for size in given.sizes:
            rows.append(measure_size(size, given.rounds))
            table.add_row(*_format_cells(rows[-1]))
    Console(width=120).print(table)
    publish_rows(given.publish, SCENE, rows, begin)


if __name__ == "__main__":
    main()
