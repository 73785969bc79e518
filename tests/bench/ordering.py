"""Measure fill and time of nested dissection, compared with minimum degree and with the preparation of CHOLMOD.

    python -m tests.bench.ordering [--sizes 64 128 256] [--solids 12 20] [--rounds 5]
        [--publish results/published/ordering]

A sheet has the system matrix of springs along sides and diagonals; a solid has springs between all neighbours. The
first table compares two orders with the same symbolic and numeric factorisation: nested dissection, and the minimum
degree order of SuperLU for the pattern of A' + A. Its columns `factor` measure the factorisation of a Hessian in blocks
of 3 x 3 with one solve, as in Newton's method; its columns `solve` measure the prefactored solve of local-global. The
second table has the preparation of local-global: ordering, symbolic factorisation and numeric factorisation, and the
whole preparation by CHOLMOD, which cholespy calls with the AMD order. Times are the least of the rounds, in ms:
processor time with one thread, wall time with two.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from os import getloadavg
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.solvers.linalg.cholesky.block_cholesky import BlockCholesky
from springbench.solvers.linalg.cholesky.nested_dissection import nested_dissection_order
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.cholesky.symbolic_factorisation import SymbolicFactor, analyse_with_order
from springbench.solvers.linalg.direct_solvers import SimplicialCholesky

from tests.bench.gates import build_sheet
from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.bench.solves import build_system_matrix
from tests.network_matrices import grid_matrix

SCENE = Path(__file__).parents[2] / "configs" / "scenes" / "hanging-cloth.yaml"


def compute_minimum_degree_order(Q: csr_array) -> NDArray[np.int32]:
    """Compute the minimum degree order (n,) of a matrix by SuperLU."""
    options = {"SymmetricMode": True}
    factor = splu(csc_array(Q), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.argsort(factor.perm_c).astype(np.int32)


def build_newton_blocks(Q: csr_array) -> NDArray[np.float64]:
    """Build the blocks (b, 3, 3) of a positive definite matrix with the pattern of Q."""
    rows = np.repeat(np.arange(Q.shape[0]), np.diff(Q.indptr))
    blocks = np.full((Q.nnz, 3, 3), -0.1) - np.eye(3)
    blocks[rows == Q.indices] = 5.0 * np.diff(Q.indptr).max() * np.eye(3)
    return blocks


def measure_least_time(work: Callable[[], object], rounds: int, clock: Callable[[], float]) -> float:
    """Measure the least time of a call over several rounds [ms]."""
    work()  # compiles, and fills the caches
    seconds = []
    for _ in range(rounds):
        begin = clock()
        work()
        seconds.append(clock() - begin)
    return 1e3 * min(seconds)


def measure_by_threads(name: str, work: Callable[[], object], rounds: int) -> dict[str, float]:
    """Measure the times of a call with one and two threads [ms]."""
    out = dict[str, float]()
    for threads, clock in (("one", thread_time), ("two", perf_counter)):
        with limit_threads(1 if threads == "one" else 2):
            out[f"{name}_{threads}_ms"] = measure_least_time(work, rounds, clock)
    return out


def measure_order(Q: csr_array, order: NDArray[np.int32], rounds: int) -> dict[str, float]:
    """Measure an order: its fill, its floating-point operations, and times of factorisation and solve [ms]."""
    symbolic = analyse_with_order(np.asarray(Q.indptr, np.int64), np.asarray(Q.indices, np.int32), order)
    newton = BlockCholesky(Q, symbolic_factor=symbolic)
    blocks, b = build_newton_blocks(Q), np.random.default_rng(0).normal(size=(Q.shape[0], 3))
    solver, out = SupernodalCholesky(Q, symbolic_factor=symbolic), np.empty_like(b)
    return {
        "nonzeros": symbolic.nonzeros,
        "flops": float(newton.flops),
        **measure_by_threads("factor", lambda: newton.factorise_and_solve(blocks, b), rounds),
        **measure_by_threads("solve", lambda: solver.solve(b, out), 4 * rounds),
    }


def measure_preparation(Q: csr_array, rounds: int) -> dict[str, float]:
    """Measure the parts of the preparation, their sum, and the whole preparation by CHOLMOD [ms]."""
    pointers, neighbours = np.asarray(Q.indptr, np.int64), np.asarray(Q.indices, np.int32)
    order = nested_dissection_order(pointers, neighbours)
    symbolic: SymbolicFactor = analyse_with_order(pointers, neighbours, order)
    works: dict[str, Callable[[], object]] = {
        "ordering_ms": lambda: nested_dissection_order(pointers, neighbours),
        "symbolic_ms": lambda: analyse_with_order(pointers, neighbours, order),
        "numeric_ms": lambda: SupernodalCholesky(Q, symbolic_factor=symbolic),
        "cholmod_ms": lambda: SimplicialCholesky(Q),
    }
    with limit_threads(1):
        times = {name: measure_least_time(work, rounds, thread_time) for name, work in works.items()}
    return times | {"prepare_ms": times["ordering_ms"] + times["symbolic_ms"] + times["numeric_ms"]}


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="*", default=[64, 128, 256])
    parser.add_argument("--solids", type=int, nargs="*", default=[12, 20])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    given = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    print(f"{describe_machine().cpu}; load {getloadavg()[0]:.1f}; times in ms")
    matrices = {f"sheet {n}": build_system_matrix(build_sheet(n)) for n in given.sizes}
    matrices |= {f"solid {n}": grid_matrix(n, n, n) for n in given.solids}
    orders = Table("matrix", "order", "fill", "flops", *("factor, 1", "2", "solve, 1", "2"), box=SIMPLE_HEAD)
    parts = Table("matrix", "ordering", "symbolic", "factor", "all", "CHOLMOD", box=SIMPLE_HEAD)
    for name, Q in matrices.items():
        dissected = nested_dissection_order(np.asarray(Q.indptr, np.int64), np.asarray(Q.indices, np.int32))
        for order, found in (("nested dissection", dissected), ("minimum degree", compute_minimum_degree_order(Q))):
            row = measure_order(Q, found, given.rounds)
            rows.append({"kind": "order", "matrix": name, "order": order} | row)
            times = (f"{row[f'{work}_{threads}_ms']:.2f}" for work in ("factor", "solve") for threads in ("one", "two"))
            orders.add_row(name, order, f"{row['nonzeros']:,}", f"{row['flops']:.3g}", *times)
        row = measure_preparation(Q, given.rounds)
        rows.append({"kind": "preparation", "matrix": name} | row)
        columns = ("ordering_ms", "symbolic_ms", "numeric_ms", "prepare_ms", "cholmod_ms")
        parts.add_row(name, *(f"{row[column]:.1f}" for column in columns))
    console = Console(width=120)
    console.print(orders)
    console.print(parts)
    publish_rows(given.publish, SCENE, rows, begin)


if __name__ == "__main__":
    main()
