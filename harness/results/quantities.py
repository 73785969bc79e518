"""Quantities of a run in tables, pictures, figures and pages.

Each quantity has one definition and one name:

    ms a step         median wall time of the timed steps, over all frames and rounds [ms]
    least             the smallest of the same times [ms]
    times as long     quotient of two runs' ms a step
    iterations        median iterations of a step, over all frames and rounds
    residual          that of the last frame [J^(1/2)]
    largest residual  maximum over all frames, where each has one
    largest strain    maximum of |length / rest length - 1| over all springs and all frames after the start
    99 % below        maximum over these frames of the 99 % quantile over the springs
    share of a cause  energy that it dissipated in all frames, relative to the energy that was provided in them

`SQL_EXPRESSIONS` computes them from the rows of one run. A recording stores the strain of each frame, and the run's ms
a step as a property computed by `compute_ms_per_step`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

DISSIPATION_CAUSES = ("damping", "friction", "integrator", "solve", "engine")
"""Causes of dissipation: damping effects, friction, the time integrator, unconverged solves, and engines, in which the
last two cannot be separated."""

SQL_EXPRESSIONS = {
    "step": "1e3 * median(seconds) filter (phase = 'step')",
    "lower": "1e3 * quantile_cont(seconds, 0.25) filter (phase = 'step')",
    "upper": "1e3 * quantile_cont(seconds, 0.75) filter (phase = 'step')",
    "least": "1e3 * min(seconds) filter (phase = 'step')",
    "num_iterations": "median(num_iterations) filter (phase = 'step')",
    "residual": "arg_max(residual, frame) filter (phase = 'step')",
    "worst_residual": "case when bool_and(residual is not null) filter (phase = 'step') then max(residual) end",
    "max_strain": "max(max_strain)",
    "strain_p99": "max(strain_p99)",
    "provided_energy": "max(provided_energy)",
    **{
        f"{cause}_share": f"sum(dissipation_{cause}) filter (phase = 'step' and \"round\" = 0) "
        "/ nullif(max(provided_energy), 0)"
        for cause in DISSIPATION_CAUSES
    },
}
"""Aggregates over the rows of a run, by the names of the fields of
`springbench.harness.report.timing_table.RunTimes`."""


def compute_ms_per_step(seconds: Sequence[float]) -> float:
    """Compute the median ms a step from wall times [s].

    The times are those of all frames and rounds.
    """
    return 1e3 * float(np.median(seconds))


def compute_slowdown(run: float, other: float) -> float:
    """Compute the ratio of two runs' times from their ms a step.

    Args:
        run: time of the run [ms].
        other: time of the run to which it is compared [ms], positive.
    """
    return run / other


def compute_max_strain(frames: NDArray[np.int64], strains: NDArray[np.float64]) -> float:
    """Compute the largest strain of a run from the strain of each frame.

    Args:
        frames: frame numbers (k,); frame 0 is the start and is excluded.
        strains: largest strain of each frame (k,).

    Returns:
        The maximum, or NaN without a frame after the start.
    """
    after = strains[frames > 0]
    return float(after.max()) if len(after) else float("nan")
