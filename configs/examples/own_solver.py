"""A solver of one's own, local-global with momentum: p' = p - Q^-1 grad g(p) + b (p - p_before) (Polyak 1964)."""

from dataclasses import dataclass
from pathlib import Path

import springbench
from springbench import FixedPointSolver, Positions


@dataclass(frozen=True)
class HeavyBall(FixedPointSolver):
    """The method and its parameter b."""

    momentum: float = 0.3

    def next_iterate(self, p: Positions, before: Positions, correction: Positions) -> Positions:
        """The next iterate; correction: Q^-1 grad g(p)."""
        return p - correction + self.momentum * (p - before)


if __name__ == "__main__":
    sweep: springbench.SweepKeys = {
        "scenes": ["../scenes/hanging-cloth.yaml"],
        "sizes": [8],
        "solvers": ["sparse", springbench.UserCodeName("./own_solver.py:HeavyBall")],
        "options": {"frames": 3, "max_iterations": 500, "rtol": 1e-4, "record": False, "pictures": False, "rounds": 1},
    }
    here = Path(globals().get("__file__", "configs/examples/own_solver.py")).parent  # a notebook is no file
    rows = springbench.run_config(sweep, name="heavy-ball", folder=here)
    print(rows[["solver", "num_iterations"]])
