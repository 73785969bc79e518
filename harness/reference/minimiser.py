"""The minimum that solvers are graded against: Newton's method to round-off, and a certificate.

At a minimum grad g = 0 and the Hessian H is positive definite. Both are checked by the oracle, `solvers.problem`,
whoever found the positions: H has a Cholesky factor, inverse iteration (Lanczos) by it gives the smallest eigenvalue,
and steps |H^-1 grad g| go on for as long as each is shorter than half of the one before, so that the last one tells
how far round-off leaves the minimum. The energy is not convex: there may be
several minima. A basin is what Newton's method with a line search, which only descends, makes it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import LinearOperator, eigsh

from harness.base.errors import RunFailed
from harness.simulation.step import FIRST_GUESSES
from solvers.linear.block import BlockCholesky
from solvers.matrices import diagonal
from solvers.problem import Positions, Solver, StepProblem, StopRule

TO_THE_END = StopRule(1000)
"""Until round-off lets nothing descend any more: a tolerance would stop at saddles too."""
NEAR = 1e-9
"""Of the shape's size: a certified minimum is known to this, and two that lie within a hundred times of it are one."""
REFACTORISATIONS = 5


class Uncertified(RunFailed):
    """There is no certified minimum to grade against."""


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """Where Newton's method ended. positions (n, 3) [m], read-only; g [J]; error: the length of the last Newton step,
    at the vertex where it is largest [m]; smallest_eigenvalue: of the Hessian without the pinned vertices [N/m], nan
    where that is not positive definite; certified: whether this is a minimum, known to `NEAR`."""

    positions: Positions
    g: float
    error: float
    smallest_eigenvalue: float
    certified: bool

    @property
    def flaw(self) -> str:
        """What is wrong with a minimum that is not certified."""
        if np.isnan(self.smallest_eigenvalue):
            return "the Hessian has no Cholesky factor"
        return f"its next step is still {self.error:.1e} m, the smallest eigenvalue {self.smallest_eigenvalue:.1e} N/m"

    @property
    def name(self) -> str:
        """6 hex digits that stay, whatever minima are found later."""
        return hashlib.sha256(self.positions.tobytes()).hexdigest()[:6]


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """The minima known of one problem, the lowest first: an index is a branch. reason: why there is none."""

    minima: tuple[Minimum, ...]
    reason: str = ""

    @property
    def best(self) -> Minimum:
        """The lowest minimum known; raises Uncertified where there is none."""
        if not self.minima:
            raise Uncertified(self.reason)
        return self.minima[0]

    def branch(self, minimum: Minimum) -> int:
        """The index of a minimum, by where it lies."""
        return next(i for i, known in enumerate(self.minima) if _same(known, minimum))

    def joined(self, found: Minimum) -> Reference:
        """With one more minimum; the same reference where it is known already, or is not certified."""
        if not found.certified or any(_same(known, found) for known in self.minima):
            return self
        return Reference(tuple(sorted((*self.minima, found), key=lambda minimum: minimum.g)))


def find_minima(problem: StepProblem, solver: Solver) -> Reference:
    """The minima to which Newton's method leads from the current positions and from the inertial target."""
    guesses = (FIRST_GUESSES[name](problem).first_guess for name in ("current", "inertial"))
    return reference(polish(problem, guess, solver) for guess in guesses)


def reference(found: Iterable[Minimum]) -> Reference:
    """The certified ones among what was found; where there is none, the reason."""
    known, reason = Reference(()), ""
    for one in found:
        known = known.joined(one)
        reason = f"no certified minimum: Newton's method ends where {one.flaw}"
    return known if known.minima else Reference((), reason)


def polish(problem: StepProblem, p: Positions, solver: Solver) -> Minimum:
    """Newton's method from p (n, 3) [m] down to the minimum of its basin, which is certified."""
    solution = solver.prepare(problem.system).solve(replace(problem, first_guess=p), TO_THE_END)
    return certify(problem, solution.positions)


def certify(problem: StepProblem, p: Positions) -> Minimum:
    """Newton steps from p (n, 3) [m], close to a minimum, to where round-off ends them; then the Hessian's spectrum."""
    p, free = _pinned(problem, p), problem.system.free
    error, smallest = np.inf, np.nan
    for _ in range(REFACTORISATIONS):
        H = free_hessian(problem, p)
        factor = _factorised(H)
        if factor is None:
            smallest = np.nan
            break
        smallest, begun, error = _smallest_eigenvalue(H, factor), p.copy(), np.inf
        while True:
            step = factor.solve(problem.gradient(p)[free])
            length = float(np.linalg.norm(step, axis=1).max(initial=0.0))
            if not length < 0.5 * error:  # round-off, or too far away for this Hessian
                break
            error = length
            p[free] -= step
        if np.abs(p - begun).max(initial=0.0) <= NEAR * _size(p):
            break
    p.flags.writeable = False
    certified = error <= NEAR * _size(p) and smallest > 0.0
    return Minimum(p, problem.value(p), error, smallest, bool(certified))


def free_hessian(problem: StepProblem, p: Positions) -> csr_array:
    """The objective's Hessian at p [N/m], without the exactly pinned vertices, (3 f, 3 f)."""
    system = problem.system
    _, vertices, weight = system.penalty
    held = system.inertia + np.bincount(vertices, weight, minlength=system.vertices)
    H = diagonal(np.repeat(held, 3))
    for energy in problem.energies:
        H = H + energy.hessian(p)
    free = (3 * system.free[:, None] + np.arange(3)).ravel()
    return csr_array(csr_array(H)[free][:, free])


def _factorised(H: csr_array) -> BlockCholesky | None:
    """The Cholesky factor of a Hessian, None where it is not positive definite."""
    blocks = bsr_array(H, blocksize=(3, 3))
    blocks.sort_indices()
    factor = BlockCholesky(csr_array((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr)))
    return factor if factor.factorise(np.array(blocks.data, np.float64)) else None


def _smallest_eigenvalue(H: csr_array, factor: BlockCholesky) -> float:
    """Of a positive definite matrix [N/m], less what round-off in its factor may have added."""
    size = len(H.indptr) - 1
    start = np.random.default_rng(0).normal(size=size)  # the same eigenvalue each time
    settings: Any = {"k": 1, "sigma": 0.0, "OPinv": _Inverse(factor, size), "v0": start, "tol": 1e-3}
    found: Any = eigsh(H, return_eigenvectors=False, **settings)
    return float(found[0]) - 4.0 * np.finfo(float).eps * float(abs(H).sum(axis=1).max())


class _Inverse(LinearOperator):
    """H^-1 of a factorised H."""

    def __init__(self, factor: BlockCholesky, size: int) -> None:
        super().__init__(np.dtype(np.float64), (size, size))
        self._solve = factor.solve

    def _matvec(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._solve(x.reshape(-1, 3)).ravel()


def _pinned(problem: StepProblem, p: Positions) -> Positions:
    """A copy of p with the exactly pinned vertices on their targets."""
    pins, placed = problem.system.pins, p.copy()
    placed[pins.vertices[pins.exact]] = problem.pin_targets[pins.exact]
    return placed


def _size(p: Positions) -> float:
    """The diagonal of the bounding box of p [m]."""
    return float(np.linalg.norm(np.ptp(p, axis=0)))


def _same(one: Minimum, other: Minimum) -> bool:
    apart = np.abs(one.positions - other.positions).max(initial=0.0)
    return bool(apart <= 100.0 * NEAR * _size(one.positions))
