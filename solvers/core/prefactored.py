"""The local-global iteration over a prefactored Q, independent of the backend of its two steps.

The method is described in `solvers.methods.local_global`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array

from solvers import matrices
from solvers.core.driver import Iterating, Iterative, largest
from solvers.energies.springs import Springs
from solvers.linear.factors import DenseCholesky, Factor
from solvers.problem import (
    Energy,
    Positions,
    ProjectiveEnergy,
    ResidualOf,
    StepProblem,
    System,
    Unsupported,
    is_lagged,
)

Project = Callable[[Positions, Positions, Positions], None]
"""A function (p, y, out) that writes y + A'K d(p) to `out`."""


_COUNTS = {"nnz_factor": "nonzeros", "panel_bytes": "panel_bytes", "flops_per_solve": "flops"}
"""Statistics of a factor, by the attribute that provides them, if any."""


@dataclass(frozen=True, eq=False)
class PreparedLocalGlobal(Iterative):
    """The iteration with any backend's local step, factor and norm.

    Attributes:
        system: the system.
        project: local step.
        factor: factor of Q's free rows and columns.
        coupling: Q's free rows and exactly pinned columns (f, x).
        norm: |e|_Q [J^(1/2)] of a displacement that vanishes at the pins.
        trace: trace of the unpinned part of Q [N/m].
        facts: exact counts of the setup.
        choice: description of the linear solver.
        lagged: builder of the local step of a problem, if it depends on the problem.
        rounded: Q's free rows and columns if the factor has low precision. The iteration then solves for
            corrections, p + Q^-1 (b - Q p), and the fixed point stays accurate to float64.
        spread: max_i Q_ii / (Q 1)_i over the free rows and columns, half of a bound on the condition
            number.
    """

    residual_of: ClassVar[ResidualOf] = "previous"

    system: System
    project: Project
    factor: Factor
    coupling: csr_array
    norm: Callable[[Positions], float]
    trace: float
    facts: dict[str, float]
    choice: str
    lagged: Callable[[StepProblem], Project] | None = None
    rounded: csr_array | None = None
    spread: float = 1.0

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return Iterations(self, problem, guess)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return largest(problem) * self.trace**0.5

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the local and the global step at the initial guess, as callables for separate timing."""
        constant, b = self.constant(problem), np.empty_like(problem.target)
        p = self.placed(problem.first_guess, problem)
        out, project = p.copy(), self.local(problem)

        def local() -> Positions:
            project(p, constant, b)
            return b

        def whole() -> Positions:
            self.toward(b, p, out)
            return out

        local()
        return {"local": local, "global": whole}

    def local(self, problem: StepProblem) -> Project:
        """Return the local step of a problem."""
        return self.lagged(problem) if self.lagged else self.project

    def constant(self, problem: StepProblem) -> Positions:
        """Return y, with the exact pins' columns of Q moved to the right-hand side."""
        s = self.system
        y = s.inertia[:, None] * problem.target + problem.force
        soft, vertices, weight = s.penalty
        y[vertices] += weight[:, None] * problem.pin_targets[soft]
        if s.pins.exact.any():
            y[s.free] -= self.coupling @ problem.pin_targets[s.pins.exact]
        return y

    def correction(self, b: Positions, out: Positions) -> Positions:
        """Write Q^-1 b, without refinement of the factor's precision, to `out` and return `out`, both (n, 3).

        Exactly pinned vertices of `out` are not changed.
        """
        free = self.system.free
        if len(free) == len(b):
            self.factor.solve(b, out)
        elif len(free):
            solved = np.empty((len(free), 3))
            self.factor.solve(b[free], solved)
            out[free] = solved
        return out

    def toward(self, b: Positions, p: Positions, out: Positions) -> None:
        """Write the solution of Q p = b to `out`, all (n, 3).

        A low-precision factor solves for the correction of p.
        """
        if self.rounded is None:
            self.correction(b, out)
            return
        free, left = self.system.free, b.copy()
        left[free] -= self.rounded @ p[free]
        self.correction(left, out)
        out[free] += p[free]

    def placed(self, p: Positions, problem: StepProblem) -> Positions:
        """Return a copy of p with the exactly pinned vertices on their targets."""
        placed = np.array(p, order="C")
        exact = self.system.pins.exact
        placed[self.system.pins.vertices[exact]] = problem.pin_targets[exact]
        return placed

    def residual(self, e: Positions) -> float:
        """Return |e|_Q [J^(1/2)] of a displacement (n, 3) [m] over the unpinned vertices.

        The pinned rows are set to zero.
        """
        e[self.system.pins.vertices] = 0.0
        return self.norm(e)


class Iterations(Iterating):
    """The state of a local-global solve with two alternating position arrays; constant: y (n, 3) [N]."""

    def __init__(self, base: PreparedLocalGlobal, problem: StepProblem, guess: Positions) -> None:
        self.base, self._project = base, base.local(problem)
        self.constant, self._b = base.constant(problem), np.empty_like(problem.target)
        self.positions, self._other = base.placed(guess, problem), base.placed(problem.current, problem)
        self._moved = False

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents descent."""
        p = self.positions
        self._project(p, self.constant, self._b)
        self.base.toward(self._b, p, self._other)
        self.positions, self._other, self._moved = self._other, p, True
        return True

    def residual(self) -> float:
        """Return |p - LG(p)|_Q of the previous positions p."""
        return self.base.residual(self._other - self.positions) if self._moved else float("nan")


def projective(system: System, solver: str) -> list[ProjectiveEnergy]:
    """Return the system's energies, all projective; raise Unsupported with the names of others."""
    energies = [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
    if len(energies) < len(system.energies):
        others = {type(e).__name__ for e in system.energies if not isinstance(e, ProjectiveEnergy)}
        raise Unsupported(f"{solver}: local-global needs projective energies; not so: {', '.join(sorted(others))}")
    return energies


def only_springs(system: System, solver: str) -> Springs:
    """Return the system's springs as one energy; raise Unsupported if it has another energy."""
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
    """Prepare the iteration with the local steps of the energies and a factor of the assembled Q.

    Args:
        system: the system.
        energies: its projective energies.
        factorise: function of Q's free part that returns a factor and a description.
        rounded: whether the factor is less precise than float64.
    """
    Q = matrices.assemble(system, energies)
    free = system.free
    rows = Q if len(free) == system.vertices else csr_array(Q[free])
    exact = system.pins.vertices[system.pins.exact]
    inner = rows if len(free) == system.vertices else csr_array(rows[:, free])
    factor, choice = factorise(inner) if len(free) else (DenseCholesky(np.eye(0)), "nothing to solve for")
    lagged = any(is_lagged(energy) for energy in energies)
    return PreparedLocalGlobal(
        system,
        _projection(energies),
        factor,
        csr_array(rows[:, exact]),
        lambda e: matrices.energy_norm(Q, e),
        float(Q.diagonal()[system.unpinned].sum()),
        facts(Q.nnz, factor),
        choice,
        (lambda problem: _projection(problem.energies)) if lagged else None,
        inner if rounded else None,
        _spread(inner),
    )


def _spread(Q: csr_array) -> float:
    """Return max_i Q_ii / (Q 1)_i; infinite if a row sum is zero or round-off."""
    sums, diagonal = Q.sum(axis=1), Q.diagonal()
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        found = np.where(sums > 0.0, diagonal / np.maximum(sums, 0.0), np.inf)
    return float(found.max(initial=1.0))


def _projection(energies: Iterable[Energy]) -> Project:
    projective = [energy for energy in energies if isinstance(energy, ProjectiveEnergy)]

    def project(p: Positions, y: Positions, out: Positions) -> None:
        out[:] = y
        for energy in projective:
            energy.add_projection(p, out)

    return project


def facts(entries: int, factor: Factor) -> dict[str, float]:
    """Return the number of entries of Q, and the statistics that the factor provides."""
    counts = {name: getattr(factor, attribute, None) for name, attribute in _COUNTS.items()}
    return {"nnz_system": float(entries)} | {name: float(n) for name, n in counts.items() if n is not None}
