"""Newton's method on the oracle, until `solvers.newton` is there: a shifted Hessian and backtracking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import csr_array

from harness.reference.minimiser import _pinned, free_hessian
from solvers.linear.factors import SparseLU
from solvers.matrices import diagonal
from solvers.problem import NotPositiveDefinite, Solution, StepProblem, StopRule, System


@dataclass(frozen=True)
class ScratchNewton:
    """Newton's method."""

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True

    def prepare(self, system: System) -> Any:
        """Nothing to prepare."""
        return self

    choice: ClassVar[str] = ""
    facts: ClassVar[dict[str, float]] = {}

    def phases(self, problem: StepProblem) -> dict[str, Any]:
        """None."""
        return {}

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Down to round-off."""
        p, free, k = _pinned(problem, problem.first_guess), problem.system.free, 0
        gradient, g = problem.gradient(p), problem.value(p)
        first = np.linalg.norm(gradient)
        for k in range(stop.iterations):
            H, shift = free_hessian(problem, p), 0.0
            weight = diagonal(np.abs(H.diagonal()))
            while True:
                try:
                    factor = SparseLU(csr_array(H + shift * weight))
                    break
                except NotPositiveDefinite:
                    shift = max(1e-3, 4.0 * shift)
            step = np.empty((len(free), 3))
            factor.solve(gradient[free].ravel(), step.reshape(-1))
            slope, length = float(np.vdot(step, gradient[free])), 1.0
            if slope <= 1e-26 * problem.magnitude(p):
                break
            while True:
                q = p.copy()
                q[free] -= length * step
                after, at = problem.value(q), problem.gradient(q)
                if after <= g - 1e-4 * length * slope:
                    break
                if slope < 1e-10 * problem.magnitude(p) and np.linalg.norm(at) < 0.9 * np.linalg.norm(gradient):
                    break
                length /= 2
                if length < 1e-8:
                    return Solution(p, k, 0.0, 0.0, "stalled")
            p, g, gradient = q, after, at
            if np.linalg.norm(gradient) <= 1e-13 * first:
                break
        return Solution(p, k + 1, 0.0, 0.0, "tolerance")
