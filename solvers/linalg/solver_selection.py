"""Selection of the linear solver for Q, from exact operation counts before any factorisation.

    inverse      n^2 entries, one product              up to MAX_DENSE_VERTICES vertices
    supernodal   2 x panels read per solve, flops once  while cheaper than the bytes that conjugate gradients read
    cg           iterations x (matrix and vectors)     beyond, and where the factor does not fit

The counts follow from the graph of Q, and the constants were measured once. No timing takes place at run time, so that
equal Q give equal choices wherever both solvers fit. If none fits in memory, the error states the counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.sparse import csr_array
from springbench.solvers.jit.kernel_compilation import cached_njit
from springbench.solvers.linalg.cholesky.supernodal_cholesky import (
    Precision,
    SupernodalCholesky,
    count_stored_entries,
)
from springbench.solvers.linalg.cholesky.symbolic_factorisation import SymbolicFactor, analyse_graph
from springbench.solvers.linalg.dense_inverse import DenseInverse
from springbench.solvers.linalg.direct_solvers import LinearSolver, SimplicialCholesky
from springbench.solvers.linalg.memory import compute_memory_limit, format_bytes
from springbench.solvers.linalg.multigrid.multigrid_pcg import ConjugateGradients
from springbench.solvers.model.step_problem import Unsupported
from springbench.solvers.model.system_matrix_assembly import energy_norm

LinearSolverName = Literal["auto", "inverse", "cholespy", "supernodal", "cg"]

MAX_DENSE_VERTICES = 25
"""Number of vertices up to which the inverse is no slower. A step of 50 iterations takes as long at 9 and 25 vertices
of a sheet, 1.15 times as long as with the supernodal factor at 49, and 1.5 times at 100."""

_AMORTISED_SOLVES = 200
"""Solves within which a factor has to pay off: 4 steps of 50 iterations. Sheets get a factor at any size, solids up to
about 80 vertices a side. Beyond, it would take minutes, and a solve would take as long as conjugate gradients."""

_BYTES_PER_FLOP = 0.4
"""Bytes read by a solve that take as long as a flop: 35 Gflop/s and 13 GB/s, on a solid of 60 vertices a side."""

_EXPECTED_CG_ITERATIONS = 10
"""Conjugate gradient iterations to the tolerance: 9 to 11 on sheets and solids of 1e4 to 1e6 vertices."""

_MAX_ERROR_REDUCTION, _POWER_ITERATIONS = 0.9, 4
"""Fraction of an error that a correction by a rounded factor may leave (at 1 corrections no longer converge), and
number of corrections by which it is estimated."""

_ROUNDED_COPY_MEMORY: dict[Precision, float] = {"float64": 0.0, "float32": 0.5, "float16": 1.25}
"""Memory of the rounded copy of a factor, relative to its float64 panels, which exist while the copy is made."""

_SYMBOLIC_BYTES_PER_VERTEX = 200
"""Bytes of the symbolic factor: 180 per vertex on a sheet of 512 vertices a side."""

_BYTES_READ_PER_ENTRY, _BYTES_STORED_PER_ENTRY = 70, 60
"""Bytes per entry of Q: read by one multigrid iteration, coarse levels included, and allocated at most during setup. A
vertex counts as four entries, for its vectors. The first is within a tenth of the measured value on sheets and solids
of 1e6 vertices. The second is above the measured ones: 38 for sheets, 31 for solids, 50 for chains and for stiffnesses
over six decades."""


@dataclass(frozen=True, slots=True)
class CostEstimate:
    """Estimated cost of a solver.

    Attributes:
        memory_bytes: peak memory during setup.
        traffic_bytes: bytes read by a solve, plus its share of the factorisation's flops converted to bytes.
        description: the underlying counts.
    """

    memory_bytes: float
    traffic_bytes: float
    description: str


class SolverChoice(NamedTuple):
    """A solver's name, the reason for its selection, and its symbolic factor if computed."""

    solver_name: str
    reason: str
    symbolic_factor: SymbolicFactor | None = None


def build_linear_solver(
    Q: csr_array,
    linear: LinearSolverName = "auto",
    precision: Precision = "float64",
    *,
    memory_limit: float | None = None,
) -> tuple[LinearSolver, str]:
    """Build a solver of Q x = b.

    Below float64, a solve has only the accuracy of the precision and is meant for corrections p - Q^-1 grad; cg always
    has float64 accuracy. If stiffnesses differ so much that rounded corrections would diverge, the factor is in
    float64.

    Args:
        Q: symmetric positive definite matrix (n, n).
        linear: name of the solver, or "auto".
        precision: precision of the factor.
        memory_limit: bytes that the solver may allocate in addition to Q; the default is that of
            `springbench.solvers.linalg.memory`.

    Returns:
        The solver, and a description with the reason for its selection.

    Raises:
        Unsupported: if no solver fits in memory.
        NotPositiveDefinite: if the matrix is not positive definite.
    """
    name, why, symbolic = select_solver(Q, linear, precision, memory_limit=memory_limit)
    found = _SOLVER_BUILDERS[name](Q, precision, symbolic)
    if precision == "float64" or name == "cg" or _error_reduction(Q, found) <= _MAX_ERROR_REDUCTION:
        return found, f"{name}: {why}"
    found, whole = build_linear_solver(Q, linear, memory_limit=memory_limit)
    return found, f"{whole}; in float64, for stiffnesses lie too far apart for {precision}"


def _error_reduction(Q: csr_array, factor: LinearSolver) -> float:
    """Estimate the largest error reduction of corrections by a rounded factor R.

    It is |e - R^-1 Q e|_Q / |e|_Q for an error e. Below 1 each correction is a descent step. A few power iterations
    from a random vector detect larger values. They occur if soft modes hide stiff ones in the rounded numbers, or if
    rounding of stiff modes perturbs soft ones.
    """
    e = np.random.default_rng(0).standard_normal((len(Q.indptr) - 1, 3))
    most, corrected, before = 0.0, np.empty_like(e), energy_norm(Q, e)
    for _ in range(_POWER_ITERATIONS):
        factor.solve(Q @ e, corrected)
        e -= corrected
        after = energy_norm(Q, e)
        if not np.isfinite(after):
            return np.inf
        if not before > 0.0:
            break
        most, before = max(most, after / before), after
    return most


def select_solver(
    Q: csr_array,
    linear: LinearSolverName = "auto",
    precision: Precision = "float64",
    *,
    memory_limit: float | None = None,
) -> SolverChoice:
    """Select the solver for Q.

    Args:
        Q: symmetric positive definite matrix (n, n).
        linear: name of the solver, or "auto".
        precision: precision of the factor.
        memory_limit: bytes that the solver may allocate; default by `springbench.solvers.linalg.memory`.

    Raises:
        Unsupported: if the solver is unknown, does not support the precision, or does not fit in memory.
    """
    if linear not in get_args(LinearSolverName):
        raise Unsupported(
            f"linear_solver: {linear!r} is unknown; expected one of {', '.join(get_args(LinearSolverName))}"
        )
    if linear == "cholespy" and precision != "float64":
        raise Unsupported(f"linear_solver: cholespy supports float64 only, not {precision}; use supernodal")
    n = len(Q.indptr) - 1
    room = compute_memory_limit() if memory_limit is None else memory_limit
    if linear == "cholespy":
        return SolverChoice(linear, "as requested; its factor is not estimated beforehand")
    if linear == "inverse" or (linear == "auto" and n <= MAX_DENSE_VERTICES):
        why = "as requested" if linear == "inverse" else f"{n} vertices, at most {MAX_DENSE_VERTICES}"
        if not _fits_in_memory(_estimate_inverse_cost(n), room):
            raise _build_memory_error(room, {"inverse": _estimate_inverse_cost(n)})
        return SolverChoice("inverse", why)
    iterative = _estimate_cg_cost(Q)
    if linear == "cg":
        if not _fits_in_memory(iterative, room):
            raise _build_memory_error(room, {"cg": iterative})
        return SolverChoice("cg", f"as requested; {iterative.description}")
    pointers, neighbours = np.asarray(Q.indptr, np.int64), np.asarray(Q.indices, np.int32)
    symbolic = analyse_graph(pointers, neighbours)
    direct = estimate_supernodal_cost(symbolic, precision)
    if linear == "supernodal":
        if not _fits_in_memory(direct, room):
            raise _build_memory_error(room, {"supernodal": direct, "cg": iterative})
        return SolverChoice("supernodal", f"as requested; {direct.description}", symbolic)
    if _fits_in_memory(direct, room) and direct.traffic_bytes <= iterative.traffic_bytes:
        return SolverChoice("supernodal", direct.description, symbolic)
    if _fits_in_memory(iterative, room):
        reason = (
            "a factor would cost more"
            if _fits_in_memory(direct, room)
            else f"a factor would not fit in {format_bytes(room)}"
        )
        return SolverChoice("cg", f"{iterative.description}; {reason} ({direct.description})")
    if _fits_in_memory(direct, room):
        return SolverChoice("supernodal", direct.description, symbolic)
    raise _build_memory_error(room, {"supernodal": direct, "cg": iterative})


def estimate_supernodal_cost(s: SymbolicFactor, precision: Precision = "float64") -> CostEstimate:
    """Estimate the cost of a supernodal factor from its symbolic factorisation.

    The memory includes the panels, and those of L and updates during factorisation.

    Args:
        s: symbolic factor of Q.
        precision: precision of the stored factor; the factorisation itself is in float64.
    """
    squares, entered = count_stored_entries(s)
    half = 2 if precision == "float16" else 4
    panels = 8 * (squares + entered)
    factor_bytes = panels if precision == "float64" else 4 * squares + half * entered
    entries, flops = _count_factorisation_work(s.parent, s.first_slot, s.row_start, s.postorder)
    memory = (
        panels
        + max(8 * entries, _ROUNDED_COPY_MEMORY[precision] * panels)
        + _SYMBOLIC_BYTES_PER_VERTEX * len(s.slot_of_vertex)
    )
    words = (
        f"its factor has {s.nonzeros:,} entries, {format_bytes(factor_bytes)} in {precision}, after {flops:.1e} flops"
    )
    return CostEstimate(memory, 2 * factor_bytes + _BYTES_PER_FLOP * flops / _AMORTISED_SOLVES, words)


def _estimate_inverse_cost(n: int) -> CostEstimate:
    size = 8.0 * n**2
    return CostEstimate(5 * size, size, f"{n**2:,} entries, {format_bytes(size)}")


def _estimate_cg_cost(Q: csr_array) -> CostEstimate:
    entries = Q.nnz + 4 * (len(Q.indptr) - 1)
    words = (
        f"{format_bytes(_BYTES_STORED_PER_ENTRY * entries)} for multigrid on {Q.nnz:,} entries, "
        f"about {_EXPECTED_CG_ITERATIONS} iterations a solve"
    )
    return CostEstimate(
        _BYTES_STORED_PER_ENTRY * entries, _EXPECTED_CG_ITERATIONS * _BYTES_READ_PER_ENTRY * entries, words
    )


def _fits_in_memory(need: CostEstimate, memory_limit: float) -> bool:
    return need.memory_bytes <= memory_limit


def _build_memory_error(memory_limit: float, needs: dict[str, CostEstimate]) -> Unsupported:
    listed = "; ".join(
        f"{name} needs {format_bytes(need.memory_bytes)} ({need.description})" for name, need in needs.items()
    )
    return Unsupported(
        f"the system does not fit in {format_bytes(memory_limit)} of memory: {listed}; use a coarser mesh"
    )


@cached_njit()
def _count_factorisation_work(parent, first, row_start, sequence):
    """Return the peak number of entries in panels and updates, and the flops."""
    nodes = len(parent)
    waiting = np.zeros(nodes + 1, np.int64)  # entries of children's updates; the last is for the roots
    most, now, panels, flops = 0, 0, 0, 0.0
    for s in sequence:
        own, below = first[s + 1] - first[s], (row_start[s + 1] - row_start[s] + 7) // 8 * 8
        panels += own * (own + below)
        now += below**2 - waiting[s]
        most = max(most, now + waiting[s])
        waiting[parent[s]] += below**2
        flops += own * (own**2 / 3.0 + own * below + 1.0 * below**2)
    return panels + most, flops


_SOLVER_BUILDERS: dict[str, Callable[[csr_array, Precision, SymbolicFactor | None], LinearSolver]] = {
    "inverse": lambda Q, precision, _: DenseInverse(Q, precision="float64" if precision == "float64" else "float32"),
    "cholespy": lambda Q, precision, _: SimplicialCholesky(Q),
    "supernodal": lambda Q, precision, symbolic: SupernodalCholesky(Q, precision=precision, symbolic_factor=symbolic),
    "cg": lambda Q, precision, _: ConjugateGradients(Q),
}
