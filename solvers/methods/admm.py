"""ADMM for the step problem (Overby, Brown, Li and Narain 2017, "ADMM contains projective dynamics").

    min  U(z) + terms quadratic in p   subject to   A p = z,   weighted by W K

    z <- argmin U(z) + W/2 |A p + u - z|_K^2
    u <- u + A p - z
    p <- argmin of the quadratic part + W/2 |A p - z + u|_K^2

For a projective energy U(z) = |z - d(z)|_K^2/2, where d(z) is the nearest vector of zero energy,
z = (d(v) + W v)/(1 + W) with v = A p + u. With W = 1 the matrix is Q and z - u = d(v). An iteration is then one of
local-global, except that it projects A p + u, the edges extended by their accumulated error. The first iteration, with
u = 0, equals local-global.

Descent is not guaranteed. At a fixed point v has the length l + (l - r)/W. A spring shorter than r/(1 + W) has no
fixed point, because its negative curvature exceeds the curvature of the weight. Small weights converge fast where no
spring is compressed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.core.driver import Iterating, Iterative
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.prefactored import PreparedLocalGlobal, prepared, projective
from solvers.energies.edges import Edges
from solvers.energies.quadratic import Quadratic
from solvers.energies.springs import Springs
from solvers.energies.strain_limits import StrainLimits
from solvers.kernels import admm as kernels
from solvers.linear.choice import factorise
from solvers.problem import Energy, Positions, StepProblem, System, Unsupported, is_lagged


@dataclass(frozen=True)
class Admm:
    """ADMM for springs, strain limits and constant quadratic forms.

    Args:
        weight: W, relative to the stiffness of each edge.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = False
    about: ClassVar[About] = About(
        "accelerated local-global",
        Reference(
            "Overby, Matthew and Brown, George E. and Li, Jie and Narain, Rahul",
            2017,
            "ADMM ⊇ Projective Dynamics: Fast Simulation of Hyperelastic Models with Dynamic Constraints",
            "10.1109/TVCG.2017.2730875",
        ),
    )

    weight: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        if not 0.0 < self.weight < np.inf:
            raise ValueError(f"weight: should be positive and finite, not {self.weight}")

    def prepare(self, system: System) -> PreparedAdmm:
        """Prepare the method for a system.

        Raises:
            Unsupported: if an energy has no projection along edges.
            NotPositiveDefinite: if the system leaves some positions undetermined.
        """
        others = {type(e).__name__ for e in system.energies if not isinstance(e, Springs | StrainLimits | Quadratic)}
        if others:
            raise Unsupported(
                f"admm: projects springs and strain limits, and solves for quadratic forms; the scene has "
                f"{', '.join(sorted(others))} as well"
            )
        energies = projective(system, "admm")
        weighted = [replace(e, stiffness=self.weight * e.stiffness) if isinstance(e, Edges) else e for e in energies]
        base = measure = prepared(system, weighted, lambda Q: factorise(Q))
        if self.weight != 1.0:
            measure = prepared(system, energies, lambda Q: factorise(Q))
        return PreparedAdmm(base, measure, Objective(system), _Projected.of(system.energies), self.weight)


@dataclass(frozen=True, eq=False)
class _Projected:
    """Edges of all springs and strain limits, with the lengths of zero energy.

    Attributes:
        edges: (m, 2) vertex indices.
        stiffness: (m,) [N/m].
        low, high: (m,) [m], bounds of the lengths at which an edge has no energy.
        direction: (m, 3), unit vectors for edges of zero length.
    """

    edges: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    rest_direction: NDArray[np.float64]

    @classmethod
    def of(cls, energies: Sequence[Energy]) -> _Projected:
        springs = Springs.joined([energy for energy in energies if isinstance(energy, Springs)])
        limits = [energy for energy in energies if isinstance(energy, StrainLimits)]
        return cls(
            np.concatenate([springs.edges, *(e.edges for e in limits)]),
            np.concatenate([springs.stiffness, *(e.stiffness for e in limits)]),
            np.concatenate([springs.rest_length, *(e.low for e in limits)]),
            np.concatenate([springs.rest_length, *(e.high for e in limits)]),
            np.concatenate([springs.rest_direction, *(e.rest_direction for e in limits)]),
        )


class PreparedAdmm(Iterative):
    """ADMM, prepared for a system.

    Attributes:
        base: the factorised ADMM matrix.
        measure: Q with its factor, for residuals.
    """

    def __init__(
        self,
        base: PreparedLocalGlobal,
        measure: PreparedLocalGlobal,
        objective: Objective,
        edges: _Projected,
        weight: float,
    ) -> None:
        self.base, self.measure, self.objective, self.edges, self.weight = base, measure, objective, edges, weight
        self.choice, self.facts = base.choice, base.facts

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return _Iterating(self, problem, guess)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] scale, below a small part of which round-off is checked."""
        return self.measure.scale(problem)


class _Iterating(Iterating):
    """State of an ADMM solve: positions and scaled dual variables.

    The scaled dual variable u (m, 3) [m] has a row per edge.
    """

    def __init__(self, prepared: PreparedAdmm, problem: StepProblem, guess: Positions) -> None:
        self._base, self._measure, edges = prepared.base, prepared.measure, prepared.edges
        if any(isinstance(energy, StrainLimits) and is_lagged(energy) for energy in problem.system.energies):
            edges = _Projected.of(problem.energies)
        self._edges = edges.edges, edges.stiffness, edges.low, edges.high, edges.rest_direction, prepared.weight
        self._step = StepObjective(prepared.objective, problem)
        self._constant = self._base.constant(problem)
        for energy in problem.energies:
            if isinstance(energy, Quadratic):
                energy.add_projection(problem.target, self._constant)
        self.positions = self._base.placed(guess, problem)
        self._right, self._u = np.empty_like(self.positions), np.zeros((len(edges.edges), 3))

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents any further change."""
        kernels.project(*self._edges, self.positions, self._constant, self._u, self._right)
        self._base.correction(self._right, self.positions)
        return True

    def residual(self) -> float:
        """Return the residual; costs a gradient and a solve in addition to those of the iteration."""
        gradient = self._step.gradient(self.positions)
        return self._measure.residual(self._measure.correction(gradient, np.zeros_like(gradient)))
