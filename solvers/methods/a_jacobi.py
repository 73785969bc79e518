"""Projective dynamics with an aggregated Jacobi global step (A-Jacobi: Lan et al. 2022).

    p <- p - S grad g(p),   S = sum over i < l of (I - D^-1 Q)^i D^-1,   D the diagonal of Q

S grad g is the result of l Jacobi sweeps on Q x = grad g from x = 0. The sum is a sparse matrix that is computed once,
so an iteration is one pass over the springs and one product, whatever l is. Its rows extend over l - 1 rings of
neighbours. I - S Q = (I - D^-1 Q)^l, and the eigenvalues of D^-1 Q lie between 0 and 2, because Q is diagonally
dominant. Hence S and 2 S^-1 - Q are positive definite. As Q majorises the Hessian, no iteration raises the energy.
With bending terms the eigenvalues can exceed 2; D is then the diagonal times half of the largest eigenvalue.

The iterations are accelerated by Chebyshev polynomials, as Wang (2015) accelerates Jacobi's method
(`solvers.methods.chebyshev`). They require nonnegative eigenvalues of I - S Q. For odd l, S is therefore
divided by the largest possible eigenvalue of S Q, 1 + (m - 1)^l, where m is that of D^-1 Q. The factor of Q serves
only to compute the residual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np
from scipy.sparse import csr_array, dia_array

from solvers.about import About, Reference
from solvers.contact.touching import without_contact
from solvers.core.acceleration import Interpreted, Scheme
from solvers.core.driver import Iterating, Iterative
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.prefactored import PreparedLocalGlobal, prepared, projective
from solvers.kernels.accelerate_coefficients import CHEBYSHEV
from solvers.linear.multigrid import largest_eigenvalue
from solvers.matrices import without_zeros
from solvers.methods.local_global_compiled import CompiledLocalGlobal
from solvers.problem import Positions, StepProblem, System, Unsupported

if TYPE_CHECKING:
    from solvers.contact.local_global import Idle

_SCHEME = Scheme("a-jacobi", CHEBYSHEV, 1, 0, True)
_MOST = 8
"""Maximum number of sweeps: with more, a row of S on a cloth has hundreds of entries."""

_ROUNDED = 2.0 + 1e-12
"""Largest eigenvalue of D^-1 Q for springs, with an allowance for round-off."""


@dataclass(frozen=True)
class AggregatedJacobi:
    """Projective dynamics whose global step is a fixed number of Jacobi sweeps.

    Args:
        sweeps: l, the number of Jacobi sweeps per iteration, 1 to 8.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True
    about: ClassVar[About] = About(
        "accelerated local-global",
        Reference(
            "Lan, Lei and Ma, Guanqun and Yang, Yin and Zheng, Changxi and Li, Minchen and Jiang, Chenfanfu",
            2022,
            "Penetration-free projective dynamics on the GPU",
            "10.1145/3528223.3530069",
        ),
    )

    sweeps: int = 2

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        require_sweeps(self.sweeps)

    def prepare(self, system: System) -> PreparedAggregatedJacobi:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy is not projective; contact is not.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        if without_contact(system) is not system:
            raise Unsupported(
                "a-jacobi: its matrix is computed once from Q, which does not include contact of vertices (Contact); "
                "use numba, chebyshev or vbd"
            )
        energies = projective(system, "a-jacobi")
        measure = cast("Idle", CompiledLocalGlobal().prepare(system))
        base = prepared(system, energies, lambda Q: (Aggregated(Q, self.sweeps), f"{self.sweeps} sweeps of Jacobi"))
        return PreparedAggregatedJacobi(base, measure, Objective(system))


def require_sweeps(sweeps: int) -> None:
    """Raise ValueError unless the number of sweeps is in the supported range."""
    if not 1 <= sweeps <= _MOST:
        raise ValueError(f"sweeps: should be from 1 to {_MOST}, not {sweeps}")


class Aggregated:
    """Several Jacobi sweeps for Q x = b from x = 0, as one sparse matrix.

    Attributes:
        nonzeros: number of stored entries of the matrix.
    """

    def __init__(self, Q: csr_array, sweeps: int) -> None:
        n, largest = len(Q.indptr) - 1, largest_eigenvalue(Q, Q.diagonal())
        damped = 0.5 * largest if largest > _ROUNDED else 1.0
        inverse = csr_array(dia_array((1.0 / (damped * Q.diagonal())[None, :], np.array([0])), shape=(n, n)))
        S = term = inverse
        for _ in range(sweeps - 1):
            term = csr_array(term - inverse @ (Q @ term))
            S = csr_array(S + term)
        if sweeps % 2:
            S = csr_array(S / (1.0 + max(0.0, largest / damped - 1.0) ** sweeps))
        self.matrix = without_zeros(S)
        self.nonzeros: int | None = int(self.matrix.nnz)

    def solve(self, b: Positions, out: Positions) -> None:
        """Compute S b.

        Args:
            b: right-hand side (n, 3).
            out: result (n, 3), overwritten.
        """
        out[:] = self.matrix @ b


class PreparedAggregatedJacobi(Iterative):
    """A-Jacobi, prepared for a system.

    Attributes:
        base: the local-global solver of Q, with S in place of its factor.
        measure: computes the residual at p by one local-global iteration; it has no other use.
    """

    def __init__(self, base: PreparedLocalGlobal, measure: Idle, objective: Objective) -> None:
        self.base, self.measure, self.objective = base, measure, objective
        self.choice = f"{base.choice}; for the residual alone {measure.choice}"
        self.facts = base.facts

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return _Iterating(self, problem, guess)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual [J^(1/2)] at positions p (n, 3) [m]."""
        return self.measure.gauge(problem)(p)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] scale, below a small part of which round-off is checked."""
        return self.base.scale(problem)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the gradient and the product with S as callables, at the initial guess."""
        step = StepObjective(self.objective, problem)
        p = step.placed(problem.first_guess)
        gradient, out = step.gradient(p), np.zeros_like(p)
        return {"local": lambda: step.gradient(p), "global": lambda: self.base.correction(gradient, out)}


class _Iterating(Interpreted):
    """State of an A-Jacobi solve; the residual is measured with the factor of Q."""

    def __init__(self, prepared: PreparedAggregatedJacobi, problem: StepProblem, guess: Positions) -> None:
        super().__init__(prepared.base, _SCHEME, StepObjective(prepared.objective, problem), guess)
        self._gauge = prepared.measure.gauge(problem)

    def residual(self) -> float:
        """Return the residual [J^(1/2)] of the iterate that `residual_of` names."""
        return self._gauge(self.positions)
