"""Local-global with momentum: p' = p - Q^-1 grad g(p) + b (p - p_before) (Polyak 1964)."""

from dataclasses import dataclass

import springbench


@dataclass(frozen=True)
class HeavyBall(springbench.FixedPointSolver):
    """The method and its parameter b, `momentum`."""

    momentum: float = 0.3

    def next_iterate(
        self, p: springbench.Positions, before: springbench.Positions, correction: springbench.Positions
    ) -> springbench.Positions:
        """Compute the next iterate; correction is Q^-1 grad g(p)."""
        return p - correction + self.momentum * (p - before)
