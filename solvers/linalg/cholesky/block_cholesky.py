"""Sparse Cholesky factorisation of a block matrix, analysed once and factorised repeatedly.

    H x = b,   H symmetric, dn x dn, with a block for each entry of a graph of n vertices

d is 3 for Hessians, and 1 for numbers. The elimination order and the supernodes are those of the graph. A factorisation
that fails is a regular result, not an error: H is then not positive definite.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.linalg import memory
from springbench.solvers.linalg.cholesky.block_front import PANEL_DEPTH, round_up_columns, round_up_rows
from springbench.solvers.linalg.cholesky.block_multifrontal import FactorisationScratch, run_stages
from springbench.solvers.linalg.cholesky.factorisation_schedule import (
    FactorisationSchedule,
    plan_schedule,
    select_solve,
)
from springbench.solvers.linalg.cholesky.frontal_structure import FrontalStructure
from springbench.solvers.linalg.cholesky.symbolic_factorisation import SymbolicFactor, analyse_graph
from springbench.solvers.linalg.cholesky.thread_team import ThreadTeam
from springbench.solvers.model.step_problem import Unsupported
from springbench.solvers.simd.front_tiles import TILE_COLUMNS, TILE_ROWS

_MIN_THREADED_FLOPS = 5e6
"""Operations of a factorisation from which a second thread pays off."""

_MIN_FACTORISATION = 0.2
"""Cost of assembling a matrix whose factorisation fails at once, as a fraction of a factorisation."""


class KernelFactor(NamedTuple):
    """Arguments of `run_stages` in one thread, without the matrix and the right-hand side.

    `schedule` factorises, and solves if there is a right-hand side; `solve_schedule` solves with the last factor.
    """

    fronts: FrontalStructure
    schedule: FactorisationSchedule
    solve_schedule: FactorisationSchedule
    panels: NDArray[np.float64]
    scratch: FactorisationScratch
    thread_team: ThreadTeam


class _Workspace(NamedTuple):
    """Schedules, scratch memory, shared state and kernel for a number of threads, None for one."""

    schedule: FactorisationSchedule
    solve_schedule: FactorisationSchedule
    scratch: FactorisationScratch
    team: ThreadTeam
    threads: int | None
    run_stages: TypedKernel


@dataclass(slots=True)
class FactorisationCount:
    """Number of factorisations so far, of one matrix or of several that share it.

    Attributes:
        total: sum over all factorisations; one that fails counts by the operations before it fails.
    """

    total: float = 0.0


class BlockCholesky:
    """Cholesky factorisation of H for one pattern of blocks.

    Factorisations and solves share their arrays, so that they cannot run concurrently. They use Numba's number of
    threads; the result does not depend on it.

    Attributes:
        nonzeros: entries of L, including the diagonal.
        flops: multiplications and additions of a factorisation, without padding.
        failed_vertex: vertex with the first pivot that was not positive in the last factorisation, or -1.
        fronts, panels: structure and entries of L, as `block_multifrontal` stores them.
    """

    def __init__(
        self,
        graph: csr_array,
        *,
        block_size: int = 3,
        symbolic_factor: SymbolicFactor | None = None,
        count: FactorisationCount | None = None,
    ) -> None:
        """Analyse a graph.

        Args:
            graph: pattern (n, n), symmetric, with an entry for each block including the diagonal.
            block_size: rows of a block, d.
            symbolic_factor: the symbolic factor, if it is known.
            count: the count to which factorisations are added; by default a new one.

        Raises:
            Unsupported: if the factor does not fit in memory.
        """
        pointers, neighbours = np.asarray(graph.indptr, np.int64), np.asarray(graph.indices, np.int32)
        s, d = symbolic_factor or analyse_graph(pointers, neighbours), block_size
        self.nonzeros = d * d * s.nonzeros - d * (d - 1) // 2 * (len(pointers) - 1)
        self.fronts = f = FrontalStructure.from_symbolic(pointers, neighbours, s, d)
        below = np.diff(f.member_start) - f.num_columns
        w, h = float(d) * f.num_columns, float(d) * below
        self._flops = w * (w * w / 3.0 + w * h + h * h)
        self._update_sizes = (round_up_columns(d * below) + 1) * round_up_rows(d * below)
        self.flops = float(self._flops.sum())
        self._count, self.failed_vertex = count or FactorisationCount(), -1
        schedule, updates = self._plan(1)
        needs, free = 8.0 * (f.panel_start[-1] + updates), memory.compute_memory_limit()
        if needs > free:
            raise Unsupported(
                f"a factor of the Hessian has {self.nonzeros:,} entries and takes "
                f"{memory.format_bytes(needs)} of memory, "
                f"where {memory.format_bytes(free)} is available; use solver numba or newton-cg, or a coarser mesh"
            )
        self.panels = memory.allocate_aligned(int(f.panel_start[-1]) + TILE_ROWS)
        self._no_values, self._no_vectors = np.empty((0, d, d)), np.empty((0, d))
        self._workspaces = {1: self._allocate(schedule, updates, 1)}

    @property
    def num_factorisations(self) -> float:
        """Factorisations so far, of this pattern and of those with the same count."""
        return self._count.total

    def _plan(self, threads: int) -> tuple[FactorisationSchedule, int]:
        """Return the schedule for a number of threads, and the entries of its updates."""
        f = self.fronts
        widths = round_up_columns(f.block_size * f.num_columns)
        return plan_schedule(f.parent, self._flops, widths, self._update_sizes, PANEL_DEPTH, threads)

    def _allocate(self, schedule: FactorisationSchedule, updates: int, threads: int) -> _Workspace:
        f, groups = self.fronts, len(schedule.group_start) - 2
        members = np.diff(f.member_start)
        rows = round_up_rows(round_up_columns(f.block_size * f.num_columns))
        rows += round_up_rows(f.block_size * (members - f.num_columns))
        front_size = int(rows.max(initial=0)) + TILE_ROWS
        scratch = FactorisationScratch(
            memory.allocate_aligned(threads * front_size).reshape(threads, -1),
            memory.allocate_aligned(updates),
            np.zeros(groups + 1, np.int64),
            np.zeros(groups + 1, np.int64),
            np.zeros((threads, TILE_COLUMNS)),
            np.zeros((threads, PANEL_DEPTH // TILE_COLUMNS, TILE_COLUMNS, TILE_COLUMNS)),
            np.zeros((threads, 2, int(members.max(initial=0)) + 1), np.int64),
        )
        team = ThreadTeam.from_task_count(groups)
        kernel = TypedKernel(run_stages)
        return _Workspace(schedule, select_solve(schedule), scratch, team, threads if threads > 1 else None, kernel)

    @property
    def num_threads(self) -> int:
        """Number of threads of a factorisation: Numba's, or one if that is faster."""
        return numba.get_num_threads() if self.flops >= _MIN_THREADED_FLOPS else 1

    @property
    def kernel_factor(self) -> KernelFactor:
        """The factor for kernels, which call `run_stages` in one thread."""
        schedule, solve_schedule, scratch, team, *_ = self._workspaces[1]
        return KernelFactor(self.fronts, schedule, solve_schedule, self.panels, scratch, team)

    def count_factorisations(self, number: float, failed_supernode: int = -1) -> None:
        """Add factorisations to the count.

        Args:
            number: number of factorisations, a fraction for those that failed.
            failed_supernode: supernode at which one more failed, -1 for none.
        """
        self._count.total += number
        if failed_supernode >= 0:
            self._count.total += float(self.failure_costs[failed_supernode])

    @cached_property
    def failure_costs(self) -> NDArray[np.float64]:
        """Cost of a factorisation that fails at each supernode (s,), relative to a whole one."""
        done = np.concatenate([[0.0], np.cumsum(self._flops)[:-1]]) / self.flops
        return np.maximum(_MIN_FACTORISATION, done)

    def _current_workspace(self) -> _Workspace:
        """Return the workspace for the current number of threads."""
        threads = self.num_threads
        if threads not in self._workspaces:
            self._workspaces[threads] = self._allocate(*self._plan(threads), threads)
        return self._workspaces[threads]

    def factorise(self, values: NDArray[np.float64]) -> bool:
        """Factorise H, with blocks (b, d, d) in the graph's order.

        Returns:
            Whether H is positive definite.
        """
        return self._factorise(values, self._no_vectors)

    def _factorise(self, values: NDArray[np.float64], x: NDArray[np.float64]) -> bool:
        schedule, _, scratch, team, threads, kernel = self._current_workspace()
        values = np.ascontiguousarray(values, np.float64)
        failed = kernel.call(self.fronts, schedule, values, self.panels, x, scratch, team, threads)
        self.failed_vertex = -1
        if failed >= 0:
            self.failed_vertex = int(scratch.failed_vertices[np.argmin(scratch.failures)])
        self.count_factorisations(int(failed < 0), failed)
        return failed < 0

    def solve(self, b: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return H^-1 b, both (n, d), with the last factorisation."""
        x = np.array(b, np.float64, order="C")
        _, schedule, scratch, team, threads, kernel = self._current_workspace()
        kernel.call(self.fronts, schedule, self._no_values, self.panels, x, scratch, team, threads)
        return x

    def factorise_and_solve(self, values: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Factorise H and return H^-1 b, faster than in two calls.

        Args:
            values: blocks (b, d, d) in the graph's order.
            b: right-hand sides (n, d).

        Returns:
            Solution (n, d); None if H is not positive definite.
        """
        x = np.array(b, np.float64, order="C")
        return x if self._factorise(values, x) else None
