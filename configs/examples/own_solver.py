"""A solver of one's own, local-global with momentum: p' = p - Q^-1 grad g(p) + b (p - p_before) (Polyak 1964)."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

import harness
from solvers.core.driver import Iterating, Iterative
from solvers.core.prefactored import prepared, projective
from solvers.linear.factors import SparseLU


@dataclass(frozen=True)
class HeavyBall:
    """The method and its parameter b."""

    momentum: float = 0.3
    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = False

    def prepare(self, system):
        return Ready(
            prepared(system, projective(system, "heavy-ball"), lambda Q: (SparseLU(Q), "SuperLU")), self.momentum
        )


class Ready(Iterative):
    """Ready for a system: Q is factorised."""

    residual_of, choice, facts = "previous", "", {}

    def __init__(self, base, momentum):
        self.base, self.momentum = base, momentum

    def begin(self, problem, guess):
        return Rolling(self, problem, guess)


class Rolling(Iterating):
    """One solve."""

    def __init__(self, ready, problem, guess):
        self.ready, self.problem, self.positions = ready, problem, ready.base.placed(guess, problem)
        self.before, self.step = self.positions, np.full_like(guess, np.nan)

    def advance(self):
        p, gradient = self.positions, self.problem.gradient(self.positions)
        self.step = self.ready.base.correction(gradient, np.zeros_like(p))  # Q^-1 grad g
        self.positions, self.before = p - self.step + self.ready.momentum * (p - self.before), p
        return True

    def residual(self):  # |Q^-1 grad g|_Q of the previous iterate
        return self.ready.base.residual(self.step.copy())


if __name__ == "__main__":
    sweep = {
        "scenes": ["../scenes/hanging-cloth.yaml"],
        "sizes": [8],
        "solvers": ["sparse", "./own_solver.py:HeavyBall"],
    }
    options = {"frames": 3, "iterations": 500, "tolerance": 1e-4, "record": False, "pictures": False, "rounds": 1}
    print(
        harness.run(sweep | {"options": options}, name="heavy-ball", folder=Path(__file__).parent).select(
            ["solver", "iterations"]
        )
    )
