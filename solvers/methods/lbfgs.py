"""L-BFGS with the prefactored matrix Q as initial metric.

Liu, Bouaziz, Kavan 2017, "Quasi-Newton Methods for Real-Time Simulation of Hyperelastic Materials"; Nocedal 1980.

    d = -H grad g(p),   H from H0 = gamma Q^-1 and the last pairs s = p' - p, y = grad g(p') - grad g(p)

gamma = s y / y Q^-1 y of the newest pair; the paper uses 1. This choice saves a third of the iterations on stiff
cloths. With no pair the direction is that of a local-global iteration. The step size is 1 unless the objective does not
decrease sufficiently; the line search then shortens it. A pair is stored if s y > .01 y Q^-1 y: where the Hessian is
positive and below Q, s y is at least y Q^-1 y, and H stays positive definite. All energies are supported; those that
are not projective do not contribute to Q.

`preconditioner: a-jacobi` replaces Q^-1 by S, the aggregate of several Jacobi sweeps
(`solvers.methods.a_jacobi`): a product with a sparse matrix, which suits a graphics processor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from solvers.about import About, Reference
from solvers.contact.touching import without_contact
from solvers.core.acceleration import Interpreted, Scheme
from solvers.core.bounds import without_bounded
from solvers.core.descent import Metric
from solvers.core.driver import Iterating, Iterative
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.prefactored import PreparedLocalGlobal, prepared
from solvers.kernels.accelerate_coefficients import LBFGS
from solvers.methods.a_jacobi import Aggregated, require_sweeps
from solvers.methods.quasi_newton import PreparedAccelerated, Windowed, prepare
from solvers.problem import Positions, Prepared, ProjectiveEnergy, StepProblem, System, Unsupported


@dataclass(frozen=True)
class Lbfgs(Windowed):
    """L-BFGS, preconditioned.

    Args:
        pairs: number of stored pairs, those of the most recent iterations.
        linear: solver of Q x = b.
        precision: floating-point type of its stored entries.
        preconditioner: initial metric, Q^-1 or its Jacobi approximation.
        sweeps: number of Jacobi sweeps of that approximation, 1 to 8.
    """

    unstated: ClassVar[frozenset[str]] = frozenset({"preconditioner", "sweeps"})

    about: ClassVar[About] = About(
        "quasi-Newton",
        Reference(
            "Liu, Tiantian and Bouaziz, Sofien and Kavan, Ladislav",
            2017,
            "Quasi-Newton methods for real-time simulation of hyperelastic materials",
            "10.1145/2990496",
        ),
        first=True,
        to_error=True,
    )

    preconditioner: Literal["factor", "a-jacobi"] = "factor"
    sweeps: int = 2

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        super().__post_init__()
        require_sweeps(self.sweeps)
        if self.preconditioner == "factor":
            return
        if self.linear != "auto":
            raise ValueError(f"linear: {self.linear} is for `preconditioner: factor`; a-jacobi solves no system")
        if self.precision != "float64":
            raise ValueError(f"precision: {self.precision} is of a factor's entries")

    def prepare(self, system: System) -> Prepared:
        """Prepare the method for a system.

        Raises:
            NotPositiveDefinite: if the system leaves some positions undetermined.
            Unsupported: if Q does not fit in memory, and for contact with the Jacobi preconditioner.
        """
        if self.preconditioner == "a-jacobi" and without_bounded(without_contact(system)) is not system:
            raise Unsupported(
                "lbfgs, preconditioner: a-jacobi: its matrix, which is made once, has no rows for what begins to "
                "touch; take preconditioner: factor"
            )
        if self.preconditioner == "factor":
            return self.by_factor(system)
        words, scheme, metric = f"{self.sweeps} sweeps of Jacobi", self._scheme, Metric(system)
        energies = [energy for energy in system.energies if isinstance(energy, ProjectiveEnergy)]
        base = prepared(system, energies, lambda Q: (Aggregated(Q, self.sweeps), words))
        return _Prepared(base, metric, scheme, Objective(system))

    def by_factor(self, system: System) -> PreparedAccelerated:
        """Prepare with the factor of Q; raises as `prepare` does."""
        return prepare(system, self._scheme, self.linear, self.precision)

    @property
    def _scheme(self) -> Scheme:
        return Scheme("lbfgs", LBFGS, self.pairs, 5, False)


class _Prepared(Iterative):
    """L-BFGS with S in place of the factor of Q, prepared.

    Residuals are measured by a separate metric.
    """

    def __init__(self, base: PreparedLocalGlobal, metric: Metric, scheme: Scheme, objective: Objective) -> None:
        self._base, self._metric, self._scheme, self._objective = base, metric, scheme, objective
        self.choice = f"{base.choice}; for the residual alone {metric.choice}"
        self.facts = base.facts

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        step = StepObjective(self._objective, problem)
        return _Iterating(self._metric, self._base, self._scheme, step, guess)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] scale, below a small part of which round-off is checked."""
        return self._base.scale(problem)


class _Iterating(Interpreted):
    """State of a solve with the Jacobi preconditioner; residuals are measured with the factor of Q."""

    def __init__(
        self, metric: Metric, base: PreparedLocalGlobal, scheme: Scheme, step: StepObjective, guess: Positions
    ) -> None:
        super().__init__(base, scheme, step, guess)
        self._metric = metric

    def residual(self) -> float:
        """Return the residual [J^(1/2)] of the iterate that `residual_of` names."""
        return self._metric.residual(self.gradient())
