"""Local-global iterations over one prefactored matrix (Liu et al. 2013, section 4).

    y = M target/dt^2 + f + w C'C p_pin                 once a step
    local step   d_e = r_e (A p)_e / |(A p)_e|          each iteration
    global step  Q p = A'K d + y

An iteration from p to LG(p) is a preconditioned gradient step of length one, Q^-1 grad g(p) = p - LG(p), and the
energy never rises in it, because A'KA - Hessian is positive semidefinite. Exact pins are eliminated: their rows
leave Q, and their columns go to the right-hand side.

Backends differ in how they do the two steps, and in nothing else: `DenseLocalGlobal` with NumPy's matrices,
`SparseLocalGlobal` with SciPy's, and `solvers.methods.local_global_compiled` with steps that are compiled as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array

from solvers import matrices, memory
from solvers.about import LIU_2013, LOCAL_GLOBAL, About
from solvers.contact.touching import without_contact
from solvers.energies.springs import TINY, Springs
from solvers.linear.factors import DenseCholesky, Factor, SparseLU
from solvers.problem import (
    Energy,
    LaggedEnergy,
    Positions,
    Prepared,
    ProjectiveEnergy,
    Solution,
    StepProblem,
    StopRule,
    System,
    Unsupported,
)

Project = Callable[[Positions, Positions, Positions], None]
"""(p, y, out): write y + A'K d(p) to `out`."""


_COUNTS = {"nnz_factor": "nonzeros", "panel_bytes": "panel_bytes", "flops_per_solve": "flops"}
"""What the facts tell of a factor that knows it."""


@dataclass(frozen=True, eq=False)
class PreparedLocalGlobal:
    """The iteration, over any backend's local step, factor and norm.

    project: the local step; factor: of Q's free rows and columns; coupling: Q's free rows and exactly pinned
    columns (f, x); norm: |e|_Q [J^(1/2)] of a displacement that vanishes at the pins; trace: of the unpinned
    part of Q [N/m]; facts: exact counts of what was built; choice: the linear solver in words; begin: the local step
    of one problem, where it differs from problem to problem; rounded: Q's free rows and columns where the factor is
    less precise: then corrections are solved for, p + Q^-1 (b - Q p), and the fixed point stays accurate to float64.
    """

    system: System
    project: Project
    factor: Factor
    coupling: csr_array
    norm: Callable[[Positions], float]
    trace: float
    facts: dict[str, float]
    choice: str
    begin: Callable[[StepProblem], Project] | None = None
    rounded: csr_array | None = None

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The iterates from `problem.first_guess`; each yielded array is overwritten two iterations later."""
        constant, b = self._constant(problem), np.empty_like(problem.target)
        project = self._local(problem)
        p, following = self._placed(problem.first_guess, problem), self._placed(problem.current, problem)
        while True:
            project(p, constant, b)
            self.toward(b, p, following)
            p, following = following, p
            yield p

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until `stop` says so; without a tolerance only the last residual is computed."""
        limit, yardstick = 0.0, float("nan")
        previous = self._placed(problem.first_guess, problem)
        floor = stop.floor * float(np.abs(previous).max(initial=0.0)) * self.trace**0.5
        if stop.tolerance is not None:
            yardstick = self._residual(
                next(self.iterates(replace(problem, first_guess=problem.current))), problem.current
            )
            limit = stop.tolerance * yardstick
        p, residual, iteration, stopped = previous, float("nan"), 0, "iterations"
        iterates = self.iterates(problem)
        for iteration in range(1, stop.iterations + 1):
            p = next(iterates)
            if stop.tolerance is not None or iteration == stop.iterations:
                residual = self._residual(p, previous)
            if stop.tolerance is not None and residual <= max(limit, floor):
                stopped = "tolerance" if residual <= limit else "floor"
                break
            previous = p
        return Solution(p, iteration, residual, yardstick, stopped)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """The local and the global step at the first guess, as callables to be timed apart."""
        constant, b = self._constant(problem), np.empty_like(problem.target)
        p = self._placed(problem.first_guess, problem)
        out, project = p.copy(), self._local(problem)

        def local() -> Positions:
            project(p, constant, b)
            return b

        def whole() -> Positions:
            self.toward(b, p, out)
            return out

        local()
        return {"local": local, "global": whole}

    def _local(self, problem: StepProblem) -> Project:
        return self.begin(problem) if self.begin else self.project

    def _constant(self, problem: StepProblem) -> Positions:
        """y, with the exact pins' columns of Q moved to the right-hand side."""
        s = self.system
        y = s.inertia[:, None] * problem.target + problem.force
        soft, vertices, weight = s.penalty
        y[vertices] += weight[:, None] * problem.pin_targets[soft]
        if s.pins.exact.any():
            y[s.free] -= self.coupling @ problem.pin_targets[s.pins.exact]
        return y

    def correction(self, b: Positions, out: Positions) -> Positions:
        """Write Q^-1 b, by the factor as it is, to `out`, which it returns, both (n, 3); exactly pinned vertices keep
        what is there."""
        free = self.system.free
        if len(free) == len(b):
            self.factor.solve(b, out)
        elif len(free):
            solved = np.empty((len(free), 3))
            self.factor.solve(b[free], solved)
            out[free] = solved
        return out

    def toward(self, b: Positions, p: Positions, out: Positions) -> None:
        """Write where Q p = b leads from p to `out`, (n, 3) all, as `correction` does; by a rounded factor, nearer."""
        if self.rounded is None:
            self.correction(b, out)
            return
        free, left = self.system.free, b.copy()
        left[free] -= self.rounded @ p[free]
        self.correction(left, out)
        out[free] += p[free]

    def _placed(self, p: Positions, problem: StepProblem) -> Positions:
        """A copy of p with the exactly pinned vertices on their targets, where they stay."""
        placed = np.array(p, order="C")
        exact = self.system.pins.exact
        placed[self.system.pins.vertices[exact]] = problem.pin_targets[exact]
        return placed

    def _residual(self, p: Positions, previous: Positions) -> float:
        e = previous - p
        e[self.system.pins.vertices] = 0.0
        return self.norm(e)


@dataclass(frozen=True)
class DenseLocalGlobal:
    """NumPy matrices and one dense Cholesky factor: for small meshes, and to be read beside the paper."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013)

    def prepare(self, system: System) -> PreparedLocalGlobal:
        """Raises Unsupported for energies other than springs, NotPositiveDefinite."""
        springs, n = only_springs(system, "dense"), system.vertices
        needs, room = 24.0 * n * (len(springs.edges) + n), memory.of_machine()  # three matrices of each shape
        if needs > room:
            raise Unsupported(
                f"dense: its matrices of {n:,} vertices and {len(springs.edges):,} springs take "
                f"{memory.in_words(needs)} of memory, where {memory.in_words(room)} may be taken; "
                "take sparse or numba, or a coarser mesh"
            )
        _, vertices, weight = system.penalty
        A = matrices.signed_incidence_matrix_dense(springs.edges, n)
        M = matrices.mass_matrix_dense(system.mass)
        C = matrices.selection_matrix_dense(vertices, n)
        Q = matrices.system_matrix_dense(A, springs.stiffness, system.factor * M, system.time_step, C, weight)
        matrices.require_determined(system, csr_array(Q))
        AtK = np.ascontiguousarray(A.T * springs.stiffness)
        r, rest_direction = springs.rest_length[:, None], springs.rest_direction

        def project(p: Positions, y: Positions, out: Positions) -> None:
            v = A @ p
            length = np.sqrt(np.einsum("ij,ij->i", v, v))[:, None]
            d = r * np.where(length <= TINY, rest_direction, v / np.maximum(length, TINY))
            np.matmul(AtK, d, out=out)
            out += y

        free = system.free
        exact = system.pins.vertices[system.pins.exact]
        factor = DenseCholesky(Q[np.ix_(free, free)])
        return PreparedLocalGlobal(
            system,
            project,
            factor,
            csr_array(Q[np.ix_(free, exact)]),
            lambda e: matrices.energy_norm(Q, e),
            float(np.diag(Q)[system.unpinned].sum()),
            _facts(int(np.count_nonzero(Q)), factor),
            "dense Cholesky",
        )


@dataclass(frozen=True)
class SparseLocalGlobal:
    """SciPy sparse matrices and one sparse factorisation, for any projective energies."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(LOCAL_GLOBAL, LIU_2013)

    def prepare(self, system: System) -> Prepared:
        """Raises Unsupported for energies that are not projective, NotPositiveDefinite."""
        if without_contact(system) is not system:
            from solvers.contact.local_global import local_global  # it builds on this module, and is not for everyone

            return local_global(self, system)
        return prepared(system, projective(system, "sparse"), lambda Q: (SparseLU(Q), "SuperLU"))


def projective(system: System, solver: str) -> list[ProjectiveEnergy]:
    """The system's energies, all of them projective; raises Unsupported, with the names of those that are not."""
    energies = [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
    if len(energies) < len(system.energies):
        others = {type(e).__name__ for e in system.energies if not isinstance(e, ProjectiveEnergy)}
        raise Unsupported(f"{solver}: local-global needs projective energies; not so: {', '.join(sorted(others))}")
    return energies


def only_springs(system: System, solver: str) -> Springs:
    """The system's springs as one energy; raises Unsupported where it has any other energy."""
    others = {type(energy).__name__ for energy in system.energies if not isinstance(energy, Springs)}
    if others:
        raise Unsupported(f"{solver}: knows springs only; the scene has {', '.join(sorted(others))} as well")
    return Springs.joined([energy for energy in system.energies if isinstance(energy, Springs)])


def prepared(
    system: System,
    energies: Sequence[ProjectiveEnergy],
    factorise: Callable[[csr_array], tuple[Factor, str]],
    *,
    rounded: bool = False,
) -> PreparedLocalGlobal:
    """The energies' own local steps, over a factor of the assembled Q that comes with its `choice`; rounded: whether
    that is less precise than float64."""
    Q = matrices.assemble(system, energies)
    free = system.free
    rows = Q if len(free) == system.vertices else csr_array(Q[free])
    exact = system.pins.vertices[system.pins.exact]
    inner = rows if len(free) == system.vertices else csr_array(rows[:, free])
    factor, choice = factorise(inner) if len(free) else (DenseCholesky(np.eye(0)), "nothing to solve for")
    lagged = any(isinstance(energy, LaggedEnergy) for energy in energies)
    return PreparedLocalGlobal(
        system,
        _projection(energies),
        factor,
        csr_array(rows[:, exact]),
        lambda e: matrices.energy_norm(Q, e),
        float(Q.diagonal()[system.unpinned].sum()),
        _facts(Q.nnz, factor),
        choice,
        (lambda problem: _projection(problem.energies)) if lagged else None,
        inner if rounded else None,
    )


def _projection(energies: Iterable[Energy]) -> Project:
    projective = [energy for energy in energies if isinstance(energy, ProjectiveEnergy)]

    def project(p: Positions, y: Positions, out: Positions) -> None:
        out[:] = y
        for energy in projective:
            energy.add_projection(p, out)

    return project


def _facts(entries: int, factor: Factor) -> dict[str, float]:
    """The entries of Q, and what the factor knows of itself."""
    counts = {name: getattr(factor, attribute, None) for name, attribute in _COUNTS.items()}
    return {"nnz_system": float(entries)} | {name: float(n) for name, n in counts.items() if n is not None}
