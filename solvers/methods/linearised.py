"""Linearised implicit Euler (Baraff and Witkin 1998): one factorisation per step, no iteration.

    (M/dt^2 + D/dt + K) (x - p) = f(p) + M v/dt,    K and D the derivatives of the forces at the start p

This is the first Newton step on the objective g from the start of the frame: (H + E) (x - p) = -grad g(p). Most cloth
codes use it. It has the order of the integrator that defines the step, 1 with implicit Euler and 2 with BDF2 (Choi and
Ko 2002) and midpoint. The accuracy of a step cannot be controlled: where springs rotate far in one step, x is far from
the minimum. E is zero wherever H has a Cholesky factor. Where compressed springs leave it none, part of their negative
lateral stiffness is removed, and if necessary all of it (`solvers.core.definite`); Choi and Ko
always remove all of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers import matrices
from solvers.about import About, Reference
from solvers.contact.touching import is_contact
from solvers.core.bounds import is_bounded
from solvers.core.definite import factorised
from solvers.core.driver import Iterating, Iterative
from solvers.core.fixed_objective import Objective
from solvers.core.forces import Whole
from solvers.core.objective import StepObjective
from solvers.problem import (
    NotPositiveDefinite,
    Positions,
    ProjectiveEnergy,
    ResidualOf,
    StepProblem,
    System,
    Unsupported,
)


@dataclass(frozen=True)
class BaraffWitkin:
    """Linearised implicit Euler: one iterate, independent of stop rule and initial guess."""

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    about: ClassVar[About] = About(
        "linearly implicit",
        Reference("Baraff, David and Witkin, Andrew", 1998, "Large steps in cloth simulation", "10.1145/280814.280821"),
        first=True,
    )

    def prepare(self, system: System) -> PreparedLinearised:
        """Prepare the method for a system.

        Raises:
            Unsupported: for contact, which starts and ends within a step, and for integrators with several stages,
                which require solved stages.
        """
        if system.speed is not None:
            raise Unsupported(
                "baraff-witkin: linearises a single stage per step, and this integrator requires solved stages; "
                "use implicit-euler, bdf2 or midpoint, or a Rosenbrock method: ros2, ros3p, rodas"
            )
        if met := next((e for e in system.energies if is_contact(e) or is_bounded(e)), None):
            raise Unsupported(
                f"baraff-witkin: linearises at the step's start, where it cannot know of what is touched in the step; "
                f"the scene has {type(met).__name__}; take a solver that minimises"
            )
        objective = Objective(system)
        Q = matrices.assemble(system, [e for e in system.energies if isinstance(e, ProjectiveEnergy)])
        factor = objective.matrix.factor
        choice = f"a factor of the Hessian with {factor.nonzeros:,} entries{objective.interpreted}"
        facts = {"nnz_hessian_factor": float(factor.nonzeros)}
        diagonal: NDArray[np.float64] = np.repeat(np.asarray(Q.diagonal(), np.float64)[system.free], 3)
        return PreparedLinearised(objective, diagonal, choice, facts)


@dataclass(frozen=True, eq=False)
class PreparedLinearised(Iterative):
    """Linearised implicit Euler, prepared for a system.

    `diagonal` is the diagonal of the free part of Q (3 f,) [N/m].
    """

    residual_of: ClassVar[ResidualOf] = "none"

    objective: Objective
    diagonal: NDArray[np.float64]
    choice: str
    facts: dict[str, float] = field(default_factory=dict[str, float])

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve whose only iteration is the whole step.

        Raises:
            NotPositiveDefinite: if no modification of the Hessian has a Cholesky factor.
        """
        step = StepObjective(self.objective, problem)
        p = step.placed(problem.current)
        hessian = step.hessian(p)
        if factorised(hessian, self.diagonal) is None:
            raise NotPositiveDefinite("the Hessian at the step's start is not finite, or no multiple of Q balances it")
        return Whole(step.placed(p - hessian.solve(step.gradient(p))), None)
