"""Selection of the linear solver for Q, from exact operation counts before any factorisation.

    inverse      n^2 entries, one product              up to SMALL vertices
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

from solvers.compiling import kept
from solvers.linear.conjugate_gradients import ConjugateGradients
from solvers.linear.factors import Factor, SimplicialCholesky
from solvers.linear.inverse import Inverse
from solvers.linear.supernodal import Supernodal, stored
from solvers.linear.symbolic import Symbolic, structure
from solvers.matrices import energy_norm
from solvers.memory import in_words, of_machine
from solvers.problem import Unsupported

Linear = Literal["auto", "inverse", "cholespy", "supernodal", "cg"]
Precision = Literal["float64", "float32", "float16"]

SMALL = 25
"""Number of vertices up to which the inverse is no slower. A step of 50 iterations takes as long at 9 and 25 vertices
of a sheet, 1.15 times as long as with the supernodal factor at 49, and 1.5 times at 100."""

_SOLVES = 200
"""Solves within which a factor has to pay off: 4 steps of 50 iterations. Sheets get a factor at any size, solids up to
about 80 vertices a side. Beyond, it would take minutes, and a solve would take as long as conjugate gradients."""

_BYTES_PER_FLOP = 0.4
"""Bytes read by a solve that take as long as a flop: 35 Gflop/s and 13 GB/s, on a solid of 60 vertices a side."""

_ITERATIONS = 10
"""Conjugate gradient iterations to the tolerance: 9 to 11 on sheets and solids of 1e4 to 1e6 vertices."""

_LEFT, _POWERS = 0.9, 4
"""Fraction of an error that a correction by a rounded factor may leave (at 1 corrections no longer converge), and
number of corrections by which it is estimated."""

_ROUNDING: dict[Precision, float] = {"float64": 0.0, "float32": 0.5, "float16": 1.25}
"""Memory of the rounded copy of a factor, relative to its float64 panels, which exist while the copy is made."""

_BYTES_PER_VERTEX = 200
"""Bytes of the symbolic factor: 180 per vertex on a sheet of 512 vertices a side."""

_BYTES_READ, _BYTES_KEPT = 70, 60
"""Bytes per entry of Q: read by one multigrid iteration, coarse levels included, and allocated at most during setup. A
vertex counts as four entries, for its vectors. The first is within a tenth of the measured value on sheets and solids
of 1e6 vertices. The second is above the measured ones: 38 for sheets, 31 for solids, 50 for chains and for stiffnesses
over six decades."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated cost of a solver.

    Attributes:
        memory: peak memory during setup.
        traffic: bytes read by a solve, plus its share of the factorisation's flops converted to bytes.
        words: the underlying counts.
    """

    memory: float
    traffic: float
    words: str


class Choice(NamedTuple):
    """A solver's name, the reason for its selection, and its symbolic factor if that was computed."""

    name: str
    why: str
    symbolic: Symbolic | None = None


def factorise(
    Q: csr_array, linear: Linear = "auto", precision: Precision = "float64", *, memory: float | None = None
) -> tuple[Factor, str]:
    """Build a solver of Q x = b.

    Below float64, a solve has only the accuracy of the precision and is meant for corrections p - Q^-1 grad; cg always
    has float64 accuracy. If stiffnesses differ so much that rounded corrections would diverge, the factor is in
    float64.

    Args:
        Q: symmetric positive definite matrix (n, n).
        linear: name of the solver, or "auto".
        precision: precision of the factor.
        memory: bytes that the solver may allocate in addition to Q; default by `solvers.memory`.

    Returns:
        The solver, and a description with the reason for its selection.

    Raises:
        Unsupported: if no solver fits in memory.
        NotPositiveDefinite: if the matrix is not positive definite.
    """
    name, why, symbolic = choose(Q, linear, precision, memory=memory)
    found = _MAKERS[name](Q, precision, symbolic)
    if precision == "float64" or name == "cg" or _left(Q, found) <= _LEFT:
        return found, f"{name}: {why}"
    found, whole = factorise(Q, linear, memory=memory)
    return found, f"{whole}; in float64, for stiffnesses lie too far apart for {precision}"


def _left(Q: csr_array, factor: Factor) -> float:
    """Estimate the largest |e - R^-1 Q e|_Q / |e|_Q of corrections of an error e by a rounded factor R.

    Below 1 each correction is a descent step. A few power iterations from a random vector detect larger values. They
    occur if soft modes hide stiff ones in the rounded numbers, or if rounding of stiff modes perturbs soft ones.
    """
    e = np.random.default_rng(0).standard_normal((len(Q.indptr) - 1, 3))
    most, corrected, before = 0.0, np.empty_like(e), energy_norm(Q, e)
    for _ in range(_POWERS):
        factor.solve(Q @ e, corrected)
        e -= corrected
        after = energy_norm(Q, e)
        if not np.isfinite(after):
            return np.inf
        if not before > 0.0:
            break
        most, before = max(most, after / before), after
    return most


def choose(
    Q: csr_array, linear: Linear = "auto", precision: Precision = "float64", *, memory: float | None = None
) -> Choice:
    """Select the solver for Q.

    Args:
        Q: symmetric positive definite matrix (n, n).
        linear: name of the solver, or "auto".
        precision: precision of the factor.
        memory: bytes that the solver may allocate; default by `solvers.memory`.

    Raises:
        Unsupported: if the solver is unknown, does not support the precision, or does not fit in memory.
    """
    if linear not in get_args(Linear):
        raise Unsupported(f"linear: {linear!r} is not known; it is one of {', '.join(get_args(Linear))}")
    if linear == "cholespy" and precision != "float64":
        raise Unsupported(f"{linear}: is used in float64 alone, not in {precision}; use supernodal")
    n = len(Q.indptr) - 1
    room = of_machine() if memory is None else memory
    if linear == "cholespy":
        return Choice(linear, "as asked; its factor is not estimated beforehand")
    if linear == "inverse" or (linear == "auto" and n <= SMALL):
        why = "as asked" if linear == "inverse" else f"{n} vertices, at most {SMALL}"
        return Choice("inverse", why) if _fits(_inverse(n), room) else _refuse(room, {"inverse": _inverse(n)})
    iterative = _iterative(Q)
    if linear == "cg":
        found = Choice("cg", f"as asked; {iterative.words}")
        return found if _fits(iterative, room) else _refuse(room, {"cg": iterative})
    pointers, neighbours = np.asarray(Q.indptr, np.int64), np.asarray(Q.indices, np.int32)
    symbolic = structure(pointers, neighbours)
    direct = estimate(symbolic, precision)
    if linear == "supernodal":
        found = Choice("supernodal", f"as asked; {direct.words}", symbolic)
        return found if _fits(direct, room) else _refuse(room, {"supernodal": direct, "cg": iterative})
    if _fits(direct, room) and direct.traffic <= iterative.traffic:
        return Choice("supernodal", direct.words, symbolic)
    if _fits(iterative, room):
        reason = "a factor would cost more" if _fits(direct, room) else f"a factor would not fit in {in_words(room)}"
        return Choice("cg", f"{iterative.words}; {reason} ({direct.words})")
    if _fits(direct, room):
        return Choice("supernodal", direct.words, symbolic)
    return _refuse(room, {"supernodal": direct, "cg": iterative})


def estimate(s: Symbolic, precision: Precision = "float64") -> Estimate:
    """Estimate the cost of a supernodal factor: its panels, and fronts and updates during factorisation."""
    squares, entered = stored(s)
    half = 2 if precision == "float16" else 4
    panels = 8 * (squares + entered)
    kept = panels if precision == "float64" else 4 * squares + half * entered
    fronts, flops = _factorisation(s.parent, s.first, s.row_start, s.sequence)
    memory = panels + max(8 * fronts, _ROUNDING[precision] * panels) + _BYTES_PER_VERTEX * len(s.slot)
    words = f"its factor has {s.nonzeros:,} entries, {in_words(kept)} in {precision}, after {flops:.1e} flops"
    return Estimate(memory, 2 * kept + _BYTES_PER_FLOP * flops / _SOLVES, words)


def _inverse(n: int) -> Estimate:
    size = 8.0 * n**2
    return Estimate(5 * size, size, f"{n**2:,} entries, {in_words(size)}")


def _iterative(Q: csr_array) -> Estimate:
    entries = Q.nnz + 4 * (len(Q.indptr) - 1)
    words = (
        f"{in_words(_BYTES_KEPT * entries)} for multigrid on {Q.nnz:,} entries, about {_ITERATIONS} iterations a solve"
    )
    return Estimate(_BYTES_KEPT * entries, _ITERATIONS * _BYTES_READ * entries, words)


def _fits(need: Estimate, room: float) -> bool:
    return need.memory <= room


def _refuse(room: float, needs: dict[str, Estimate]) -> Choice:
    listed = "; ".join(f"{name} needs {in_words(need.memory)} ({need.words})" for name, need in needs.items())
    raise Unsupported(f"the system does not fit in {in_words(room)} of memory: {listed}; use a coarser mesh")


@kept()
def _factorisation(parent, first, row_start, sequence):
    """Return the peak number of entries in fronts and pending updates, and the flops, of the factorisation."""
    nodes = len(parent)
    waiting = np.zeros(nodes + 1, np.int64)  # of each supernode's children; the last is the roots'
    most, now, largest, flops = 0, 0, 0, 0.0
    for s in sequence:
        own, below = first[s + 1] - first[s], (row_start[s + 1] - row_start[s] + 3) // 4 * 4
        largest = max(largest, own + below)
        now += below**2 - waiting[s]
        most = max(most, now + waiting[s])
        waiting[parent[s]] += below**2
        flops += own * (own**2 / 3.0 + own * below + 1.0 * below**2)
    return largest**2 + most, flops


_MAKERS: dict[str, Callable[[csr_array, Precision, Symbolic | None], Factor]] = {
    "inverse": lambda Q, precision, _: Inverse(Q, precision="float64" if precision == "float64" else "float32"),
    "cholespy": lambda Q, precision, _: SimplicialCholesky(Q),
    "supernodal": lambda Q, precision, symbolic: Supernodal(Q, precision=precision, symbolic=symbolic),
    "cg": lambda Q, precision, _: ConjugateGradients(Q),
}
