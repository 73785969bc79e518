"""Vertex block descent (Chen, Liu, Yang and Yuksel 2024): one vertex after another takes a Newton step of its own.

    B_i d_i = -grad_i g(p),   p_i += d_i,   B_i = held_i I + sum over its springs of k (nn' + max(0, 1 - r/l) (I - nn'))

with n the direction and l the length of a spring; compressed springs lose their negative lateral curvature, so B_i is
positive definite. The paper skips the line search. Here a step that would raise the energy, which a few additions a
spring tell, gives way to that of the majorant (held_i + sum of k) I, which cannot: so no sweep raises the objective.
Vertices go by colour: none is joined by a spring to another of its colour.

Sweeps are accelerated by Chebyshev's semi-iteration with the spectral radius rho (Wang 2015),

    p_{k+1} = w_{k+1} (sweep(p_k) - p_{k-1}) + p_{k-1},    w_1 = 1,  w_2 = 2/(2 - rho^2),  w_{k+1} = 4/(4 - rho^2 w_k),

safeguarded: an extrapolation that would raise the objective above that of p_k is not taken, and the factors begin
again at w_1. With these restarts rho needs no tuning: too large a one is no worse than the right one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers import blocks, colouring
from solvers.compiled import CompiledLocalGlobal
from solvers.kernels import vbd as kernels
from solvers.kernels.xpbd import Constraints
from solvers.local_global import only_springs
from solvers.problem import Positions, Prepared, Solution, StepProblem, StopRule, System


@dataclass(frozen=True)
class VertexBlockDescent:
    """Vertex block descent over springs.

    spectral_radius: rho of the acceleration, at least 0 and less than 1; 0 does not accelerate.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True

    spectral_radius: float = 0.999

    def __post_init__(self) -> None:
        """Raises ValueError."""
        if not 0.0 <= self.spectral_radius < 1.0:
            raise ValueError(f"spectral_radius: should be at least 0 and less than 1, not {self.spectral_radius}")

    def prepare(self, system: System) -> PreparedVertexBlockDescent:
        """Raises Unsupported for energies other than springs, NotPositiveDefinite."""
        springs = only_springs(system, "vbd")
        measure = CompiledLocalGlobal().prepare(system)
        held = blocks.held(system)
        coloured = colouring.of_vertices(springs.edges, system.vertices)
        order = coloured.order[np.isfinite(held[coloured.order])]
        return PreparedVertexBlockDescent(
            system,
            self.spectral_radius,
            kernels.Blocks.of(springs, order, held),
            Constraints.of(springs, np.arange(len(springs.edges))),
            np.where(np.isfinite(held), held, 0.0),
            measure,
            f"vertices in {coloured.colours} colours; for the residual alone {measure.choice}",
        )


@dataclass(frozen=True, eq=False)
class PreparedVertexBlockDescent:
    """blocks: of the free vertices; springs: all of them; held (n,) [N/m], 0 at exact pins; measure: one iteration of
    local-global from p tells the residual at p, and is asked for nothing else."""

    system: System
    spectral_radius: float
    blocks: kernels.Blocks
    springs: Constraints
    held: NDArray[np.float64]
    measure: Prepared
    choice: str

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built."""
        return self.measure.facts

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The iterates from `problem.first_guess`; the yielded array is overwritten by the next one."""
        p, advance = self._begin(problem)
        while True:
            advance(1)
            yield p

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until `stop` says so; the residual is that of the positions."""
        p, advance = self._begin(problem)
        if stop.tolerance is None:
            advance(stop.iterations)
            return Solution(p, stop.iterations, self._residual(problem, p), np.nan, "iterations")
        unpinned = self.system.unpinned[self.blocks.vertex]
        floor = stop.floor * float(np.abs(p).max(initial=0.0)) * float(self.blocks.majorant[unpinned].sum()) ** 0.5
        yardstick = residual = self._residual(problem, problem.current)
        limit = stop.tolerance * yardstick
        for iteration in range(1, stop.iterations + 1):
            advance(1)
            residual = self._residual(problem, p)
            if residual <= max(limit, floor):
                return Solution(p, iteration, residual, yardstick, "tolerance" if residual <= limit else "floor")
        return Solution(p, stop.iterations, residual, yardstick, "iterations")

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """None: an iteration has no parts."""
        return {}

    def _begin(self, problem: StepProblem) -> tuple[Positions, Callable[[int], None]]:
        """Positions at the first guess, and what does a number of iterations on them."""
        p, y = blocks.placed(problem.first_guess, problem), blocks.pull(problem)
        entries = int(np.diff(self.blocks.start).max(initial=0))
        near, omega, before, older = np.empty(4 * entries), np.zeros(1), np.empty_like(p), p.copy()
        fixed = self.blocks, self.springs, self.held, y, near, self.spectral_radius, omega, before, older, p
        return p, partial(kernels.iterate, *fixed)

    def _residual(self, problem: StepProblem, p: Positions) -> float:
        """|Q^-1 grad g(p)|_Q [J^(1/2)] over the unpinned vertices."""
        return self.measure.solve(replace(problem, first_guess=p), StopRule(1)).residual
