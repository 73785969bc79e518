"""Text of the column `solver_phases`: the methods that a solver switched between in a step.

    lbfgs 4 (0.21 ms, 1% of cost); predicted tensions 6 (5.3 ms, 85% of cost); newton 1 (0.9 ms, 14% of cost)

Iterations and shares of the cost are the same in each repetition of a run; times are not.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

SECONDS_PATTERN = r"[0-9.e+-]+ ms, "
"""Regular expression of the times in the text."""


def format_phases(solves: Iterable[Mapping[str, tuple[int, float, float]]]) -> str | None:
    """Format the phases of a step's solves, summed by method.

    Args:
        solves: iterations, counted cost and processor time [s] of each method, for each solve.

    Returns:
        The text; None without phases.
    """
    totals: dict[str, tuple[int, float, float]] = {}
    for phases in solves:
        for name, (count, cost, seconds) in phases.items():
            so_far = totals.get(name, (0, 0.0, 0.0))
            totals[name] = so_far[0] + count, so_far[1] + cost, so_far[2] + seconds
    whole = sum(cost for _, cost, _ in totals.values()) or 1.0
    return (
        "; ".join(
            f"{name} {count} ({1e3 * seconds:.3g} ms, {cost / whole:.0%} of cost)"
            for name, (count, cost, seconds) in totals.items()
        )
        or None
    )
