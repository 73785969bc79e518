"""How threads share the tasks of a step: who does which, and when all are done. A few atomic integers, no lock.

Tasks are claimed, never handed out, and whoever finishes the last one of a phase goes on to the next phase. So nobody
waits for a thread that has not come, only for one that is at a task. A thread with nothing to do looks for the next
phase without a pause, which takes it up at once, and after some microseconds gives its core to whoever wants it.
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
"""Places in `signals`; the first two have a cache line each."""

_OVER = -1
_SPINS = 2000
"""A waiting thread asks so often whether the next phase has begun; after that it lets other programs have its core
between two questions. They take about as long as an iteration on the smallest mesh on which a second thread pays."""

_offer_core: Any = types.ExternalFunction("sched_yield", types.intc())


class Team(NamedTuple):
    """What threads tell each other.

    signals: the phase, how many of its tasks are done, and the last phase in which each task was claimed; sums: what
    the tasks found; found (2,): what the step ended with.
    """

    signals: NDArray[np.int64]
    sums: NDArray[np.float64]
    found: NDArray[np.float64]

    @classmethod
    def of(cls, tasks: int) -> Team:
        """For so many tasks a phase."""
        return cls(np.zeros(_CLAIMS + tasks, np.int64), np.zeros(tasks), np.zeros(2))


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


def _swap(typingctx: Any, signals: Any, place: Any, before: Any, after: Any) -> Any:
    """Whether signals[place] was `before`, and now is `after`."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _place(context, builder, signature.args[0], args[0], args[1])
        return builder.extract_value(builder.cmpxchg(at, args[2], args[3], "acq_rel", "monotonic"), 1)

    return types.boolean(signals, types.int64, types.int64, types.int64), generate


def _add_one(typingctx: Any, signals: Any, place: Any) -> Any:
    """Add one to signals[place], and return what it was."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _place(context, builder, signature.args[0], args[0], args[1])
        return builder.atomic_rmw("add", at, ir.Constant(ir.IntType(64), 1), "acq_rel")

    return types.int64(signals, types.int64), generate


def _read(typingctx: Any, signals: Any, place: Any) -> Any:
    """signals[place], and sight of all that was written before it."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(_place(context, builder, signature.args[0], args[0], args[1]), "acquire", 8)

    return types.int64(signals, types.int64), generate


def _write(typingctx: Any, signals: Any, place: Any, value: Any) -> Any:
    """Write signals[place], after all that was written before."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store_atomic(args[2], _place(context, builder, signature.args[0], args[0], args[1]), "release", 8)
        return context.get_dummy_value()

    return types.void(signals, types.int64, types.int64), generate


# Numba passes the first argument itself, which type checkers do not know.
_swap_in: Any = intrinsic(_swap)
_count: Any = intrinsic(_add_one)
_look: Any = intrinsic(_read)
_tell: Any = intrinsic(_write)


@inner
def start(team):
    """Before the threads come: phase 0, no task of it claimed."""
    team.signals[:_CLAIMS] = 0
    team.signals[_CLAIMS:] = -1


@inner
def claim(team, task, phase):
    """Whether this thread is to do the task in this phase."""
    before = _look(team.signals, _CLAIMS + task)
    return before < phase and _swap_in(team.signals, _CLAIMS + task, before, phase)


@inner
def last(team):
    """A task is done: whether it was the last one of its phase, so that this thread is to end the phase."""
    if _count(team.signals, _DONE) < len(team.sums) - 1:
        return False
    team.signals[_DONE] = 0
    return True


@inner
def go_on(team, phase):
    """End a phase with a later one."""
    _tell(team.signals, _PHASE, phase)


@inner
def finish(team):
    """End the last phase."""
    _tell(team.signals, _PHASE, _OVER)


@inner
def following(team, phase):
    """Wait for the end of a phase; the next one, negative where there is none."""
    looks = 0
    now = _look(team.signals, _PHASE)
    while now == phase:
        looks += 1
        if looks > _SPINS:
            _offer_core()
        now = _look(team.signals, _PHASE)
    return now
