"""Thread team: lock-free work sharing among threads within a step, by a few atomic integers.

Threads claim tasks; none are assigned. The thread that completes the last task of a phase starts the next phase. A
thread thus never waits for one that has not started, only for one that is processing a task. An idle thread spins until
the next phase begins, and after some microseconds yields its core to other programs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from solvers.compiling import inner

_PHASE, _DONE, _CLAIMS = 0, 8, 16
"""Indices into `signals`; the first two have separate cache lines."""

_OVER = -1
_SPINS = 2000
"""Number of polls before a waiting thread yields its core between polls. They take about as long as an iteration on the
smallest mesh on which a second thread pays off."""

_offer_core: Any = types.ExternalFunction("sched_yield", types.intc())


class Team(NamedTuple):
    """Shared state of the threads.

    Attributes:
        signals: the phase, the number of its completed tasks, and the last phase in which each task was claimed.
        sums: results of the tasks.
        found: final results of the step, (2,).
    """

    signals: NDArray[np.int64]
    sums: NDArray[np.float64]
    found: NDArray[np.float64]

    @classmethod
    def of(cls, tasks: int) -> Team:
        """Allocate the state for a number of tasks per phase."""
        return cls(np.zeros(_CLAIMS + tasks, np.int64), np.zeros(tasks), np.zeros(2))


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


def _swap(typingctx: Any, signals: Any, place: Any, before: Any, after: Any) -> Any:
    """Replace signals[place] by `after` if it equals `before`; return whether it did."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _place(context, builder, signature.args[0], args[0], args[1])
        return builder.extract_value(builder.cmpxchg(at, args[2], args[3], "acq_rel", "monotonic"), 1)

    return types.boolean(signals, types.int64, types.int64, types.int64), generate


def _add_one(typingctx: Any, signals: Any, place: Any) -> Any:
    """Add one to signals[place], and return its previous value."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _place(context, builder, signature.args[0], args[0], args[1])
        return builder.atomic_rmw("add", at, ir.Constant(ir.IntType(64), 1), "acq_rel")

    return types.int64(signals, types.int64), generate


def _read(typingctx: Any, signals: Any, place: Any) -> Any:
    """Return signals[place] with acquire ordering."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(_place(context, builder, signature.args[0], args[0], args[1]), "acquire", 8)

    return types.int64(signals, types.int64), generate


def _write(typingctx: Any, signals: Any, place: Any, value: Any) -> Any:
    """Write signals[place] with release ordering."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store_atomic(args[2], _place(context, builder, signature.args[0], args[0], args[1]), "release", 8)
        return context.get_dummy_value()

    return types.void(signals, types.int64, types.int64), generate


# Numba passes the first argument itself, which type checkers cannot see.
_swap_in: Any = intrinsic(_swap)
_count: Any = intrinsic(_add_one)
_look: Any = intrinsic(_read)
_tell: Any = intrinsic(_write)


@inner
def start(team):
    """Reset the state before the threads start: phase 0, with no task claimed."""
    team.signals[:_CLAIMS] = 0
    team.signals[_CLAIMS:] = -1


@inner
def claim(team, task, phase):
    """Return whether this thread has claimed the task of a phase."""
    before = _look(team.signals, _CLAIMS + task)
    return before < phase and _swap_in(team.signals, _CLAIMS + task, before, phase)


@inner
def last(team):
    """Mark a task as completed; return whether it was the last one of its phase.

    The thread that gets True must end the phase.
    """
    if _count(team.signals, _DONE) < len(team.sums) - 1:
        return False
    team.signals[_DONE] = 0
    return True


@inner
def go_on(team, phase):
    """Release a later phase."""
    _tell(team.signals, _PHASE, phase)


@inner
def finish(team):
    """End the last phase."""
    _tell(team.signals, _PHASE, _OVER)


@inner
def following(team, phase):
    """Wait for the end of a phase; return the next one, negative if there is none."""
    looks = 0
    now = _look(team.signals, _PHASE)
    while now == phase:
        looks += 1
        if looks > _SPINS:
            _offer_core()
        now = _look(team.signals, _PHASE)
    return now
