"""The clock of a solve's phases, which the caller provides.

Solvers read no clock of their own, so that their decisions cannot depend on time. A solver that switches between
methods calls the caller's function at each change of the method, outside of compiled loops, and only reports the
differences (`springbench.solvers.model.step_problem.Solution.solver_phases`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar


def _stand_still() -> float:
    """Return 0: without a clock, phases have no duration."""
    return 0.0


_phase_clock: ContextVar[Callable[[], float]] = ContextVar("phase_clock", default=_stand_still)


def get_phase_clock() -> Callable[[], float]:
    """Return the clock [s] of the current context."""
    return _phase_clock.get()


@contextmanager
def measure_phases(clock: Callable[[], float]) -> Iterator[None]:
    """Within this context, solves measure the durations of their phases.

    Args:
        clock: function that returns a time [s].
    """
    token = _phase_clock.set(clock)
    try:
        yield
    finally:
        _phase_clock.reset(token)
