"""L-BFGS preconditioned by the prefactored matrix (Liu, Bouaziz, Kavan 2017, "Quasi-Newton Methods for Real-Time
Simulation of Hyperelastic Materials"; Nocedal 1980).

    d = -H grad g(p),   H from H0 = gamma Q^-1 and the last pairs s = p' - p, y = grad g(p') - grad g(p)

gamma = s y / y Q^-1 y of the newest pair, which the paper leaves at 1; it saves a third of the iterations on stiff
cloths. With no pair the direction is a local-global iteration. It is taken at full length unless the objective does
not fall enough; then the line search shortens it. A pair is kept if s y > .01 y Q^-1 y: where the Hessian is positive
and below Q, s y is not less than y Q^-1 y, and H stays positive definite. Takes any energies: those that are not
projective leave Q as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from solvers.about import About, Reference
from solvers.core.acceleration import Scheme
from solvers.kernels.accelerate_coefficients import LBFGS
from solvers.methods.quasi_newton import PreparedAccelerated, Windowed, prepare
from solvers.problem import System


@dataclass(frozen=True)
class Lbfgs(Windowed):
    """pairs: kept of the latest iterations; linear, precision: the solver of Q x = b and of its stored entries."""

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

    def prepare(self, system: System) -> PreparedAccelerated:
        """Raises NotPositiveDefinite, and Unsupported where Q fits nowhere."""
        return prepare(system, Scheme("lbfgs", LBFGS, self.pairs, 5, False), self.linear, self.precision)
