"""What is prefactored: Q, its factor and its norm, with the local-global iteration over them (see
`solvers.methods.local_global`), whatever the backend of the two steps.
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
"""(p, y, out): write y + A'K d(p) to `out`."""


_COUNTS = {"nnz_factor": "nonzeros", "panel_bytes": "panel_bytes", "flops_per_solve": "flops"}
"""What the facts tell of a factor that knows it."""


@dataclass(frozen=True, eq=False)
class PreparedLocalGlobal(Iterative):
    """The iteration, over any backend's local step, factor and norm.

    project: the local step; factor: of Q's free rows and columns; coupling: Q's free rows and exactly pinned
    columns (f, x); norm: |e|_Q [J^(1/2)] of a displacement that vanishes at the pins; trace: of the unpinned
    part of Q [N/m]; facts: exact counts of what was built; choice: the linear solver in words; lagged: the local step
    of one problem, where it differs from problem to problem; rounded: Q's free rows and columns where the factor is
    less precise: then corrections are solved for, p + Q^-1 (b - Q p), and the fixed point stays accurate to float64;
    spread: max_i Q_ii / (Q 1)_i over its free rows and columns, half of what bounds its condition.
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
        """See Iterative."""
        return Iterations(self, problem, guess)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return largest(problem) * self.trace**0.5

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """The local and the global step at the first guess, as callables to be timed apart."""
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
        """The local step of one problem."""
        return self.lagged(problem) if self.lagged else self.project

    def constant(self, problem: StepProblem) -> Positions:
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

    def placed(self, p: Positions, problem: StepProblem) -> Positions:
        """A copy of p with the exactly pinned vertices on their targets, where they stay."""
        placed = np.array(p, order="C")
        exact = self.system.pins.exact
        placed[self.system.pins.vertices[exact]] = problem.pin_targets[exact]
        return placed

    def residual(self, e: Positions) -> float:
        """|e|_Q [J^(1/2)] of a displacement (n, 3) [m] over the unpinned vertices; the others' are set to zero."""
        e[self.system.pins.vertices] = 0.0
        return self.norm(e)


class Iterations(Iterating):
    """Positions and those before them take turns at two arrays; constant: y (n, 3) [N]."""

    def __init__(self, base: PreparedLocalGlobal, problem: StepProblem, guess: Positions) -> None:
        self.base, self._project = base, base.local(problem)
        self.constant, self._b = base.constant(problem), np.empty_like(problem.target)
        self.positions, self._other = base.placed(guess, problem), base.placed(problem.current, problem)
        self._moved = False

    def advance(self) -> bool:
        """See Iterating."""
        p = self.positions
        self._project(p, self.constant, self._b)
        self.base.toward(self._b, p, self._other)
        self.positions, self._other, self._moved = self._other, p, True
        return True

    def residual(self) -> float:
        """|p - LG(p)|_Q of the previous positions p."""
        return self.base.residual(self._other - self.positions) if self._moved else float("nan")


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
    """max_i Q_ii / (Q 1)_i; infinite where a row's sum is nothing, or round-off."""
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
    """The entries of Q, and what the factor knows of itself."""
    counts = {name: getattr(factor, attribute, None) for name, attribute in _COUNTS.items()}
    return {"nnz_system": float(entries)} | {name: float(n) for name, n in counts.items() if n is not None}
