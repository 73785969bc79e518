"""ADMM for the step problem (Overby, Brown, Li and Narain 2017, "ADMM contains projective dynamics").

    min  U(z) + what is quadratic in p   subject to   A p = z,   weighted by W K

    z <- argmin U(z) + W/2 |A p + u - z|_K^2
    u <- u + A p - z
    p <- argmin of the quadratic part + W/2 |A p - z + u|_K^2

For a projective energy U(z) = |z - d(z)|_K^2/2, with d the nearest vector at which an edge costs nothing, z = (d(v) +
W v)/(1 + W) where v = A p + u. With W = 1 the matrix is Q and z - u = d(v): an iteration is one of local-global, but it
projects A p + u, the edges lengthened by what they were off. The first one, with u = 0, is local-global itself.

It need not descend. At a fixed point v has the length l + (l - r)/W: a spring shorter than r/(1 + W) has none, for
there its energy curves down by more than the weight curves up. Small weights are soon there where no spring is pressed.
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
    """The alternating direction method of multipliers, over springs, strain limits and constant quadratic forms.

    weight: W, in the stiffness of each edge.
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
        """Raises ValueError."""
        if not 0.0 < self.weight < np.inf:
            raise ValueError(f"weight: should be positive and finite, not {self.weight}")

    def prepare(self, system: System) -> PreparedAdmm:
        """Raises Unsupported for energies that have no projection along edges, NotPositiveDefinite."""
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
    """All springs and strain limits: edges (m, 2), stiffness (m,) [N/m], the lengths that cost nothing (m,) [m], and
    directions of edges of zero length (m, 3)."""

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
    """The method, ready for a system. base: its matrix, and measure: Q, with their factors."""

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
        """See Iterative."""
        return _Iterating(self, problem, guess)

    def scale(self, problem: StepProblem) -> float:
        """See Iterative."""
        return self.measure.scale(problem)


class _Iterating(Iterating):
    """Positions, and u of each edge (m, 3) [m]."""

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
        """See Iterating."""
        kernels.project(*self._edges, self.positions, self._constant, self._u, self._right)
        self._base.correction(self._right, self.positions)
        return True

    def residual(self) -> float:
        """See Iterating: a gradient and a solve beside those of the iteration."""
        gradient = self._step.gradient(self.positions)
        return self._measure.residual(self._measure.correction(gradient, np.zeros_like(gradient)))
