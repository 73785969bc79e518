"""Thread team: lock-free work sharing among threads within a step, by a few atomic integers.

Threads claim tasks; none are assigned. The thread that completes the last task of a phase starts the next phase. A
thread thus never waits for one that has not started, only for one that is processing a task. An idle thread spins until
the next phase begins, and after some microseconds yields its core to other programs.

Numba loses an exception that a thread of a parallel loop raises. `call_in_thread` stores it and ends all phases, and
`raise_thread_error` raises it again after the loop.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.callconv import RETCODE_USEREXC
from numba.extending import intrinsic
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_inner

_PHASE_INDEX, _ERROR_INDEX, _DONE_INDEX, _CLAIMS_INDEX = 0, 1, 8, 16
"""Indices into `signals`; the phase, which is polled, and the count of completed tasks have separate cache lines."""

_ERROR_PLACE: Any = ir.Constant(ir.IntType(64), _ERROR_INDEX)

_FINISHED = -1
_MAX_SPINS = 2000
"""Number of polls before a waiting thread yields its core between polls. They take about as long as an iteration on the
smallest mesh on which a second thread pays off."""

_yield_core: Any = types.ExternalFunction("sched_yield", types.intc())


class ThreadTeam(NamedTuple):
    """Shared state of the threads.

    Attributes:
        signals: the phase, the address of an exception or 0, the number of completed tasks of the phase, and the last
            phase in which each task was claimed.
        task_sums: results of the tasks.
        results: final results of the step, (2,).
    """

    signals: NDArray[np.int64]
    task_sums: NDArray[np.float64]
    results: NDArray[np.float64]

    @classmethod
    def from_task_count(cls, tasks: int) -> ThreadTeam:
        """Allocate the state for a number of tasks per phase."""
        return cls(np.zeros(_CLAIMS_INDEX + tasks, np.int64), np.zeros(tasks), np.zeros(2))


def _element_pointer(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


def _compare_and_swap_code(typingctx: Any, signals: Any, place: Any, before: Any, after: Any) -> Any:
    """Replace signals[place] by `after` if it equals `before`; return whether it did."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _element_pointer(context, builder, signature.args[0], args[0], args[1])
        return builder.extract_value(builder.cmpxchg(at, args[2], args[3], "acq_rel", "monotonic"), 1)

    return types.boolean(signals, types.int64, types.int64, types.int64), generate


def _fetch_add_code(typingctx: Any, signals: Any, place: Any) -> Any:
    """Add one to signals[place], and return its previous value."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _element_pointer(context, builder, signature.args[0], args[0], args[1])
        return builder.atomic_rmw("add", at, ir.Constant(ir.IntType(64), 1), "acq_rel")

    return types.int64(signals, types.int64), generate


def _load_acquire_code(typingctx: Any, signals: Any, place: Any) -> Any:
    """Return signals[place] with acquire ordering."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(
            _element_pointer(context, builder, signature.args[0], args[0], args[1]), "acquire", 8
        )

    return types.int64(signals, types.int64), generate


def _store_release_code(typingctx: Any, signals: Any, place: Any, value: Any) -> Any:
    """Write signals[place] with release ordering."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store_atomic(
            args[2], _element_pointer(context, builder, signature.args[0], args[0], args[1]), "release", 8
        )
        return context.get_dummy_value()

    return types.void(signals, types.int64, types.int64), generate


def _call_storing_error_code(typingctx: Any, signals: Any, function: Any, arguments: Any) -> Any:
    """Call a kernel, and return whether it raised an exception.

    The address of the exception is stored in `signals`.
    """
    call = function.get_call_type(typingctx, arguments.types, {})

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        compiled = function.dispatcher.get_compile_result(call)
        context.active_code_library.add_linking_library(compiled.library)
        values = cgutils.unpack_tuple(builder, args[2])
        status, _ = context.call_conv.call_function(
            builder,
            context.declare_function(builder.module, compiled.fndesc),
            compiled.fndesc.restype,
            compiled.fndesc.argtypes,
            values,
        )
        with cgutils.if_unlikely(builder, status.is_error):
            at = _element_pointer(context, builder, signature.args[0], args[0], _ERROR_PLACE)
            builder.store_atomic(builder.ptrtoint(status.excinfoptr, ir.IntType(64)), at, "release", 8)
        return status.is_error

    return types.boolean(signals, function, arguments), generate


def _raise_stored_error_code(typingctx: Any, signals: Any) -> Any:
    """Raise the exception whose address is stored in signals, if there is one."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        at = _element_pointer(context, builder, signature.args[0], args[0], _ERROR_PLACE)
        stored = builder.load_atomic(at, "acquire", 8)
        with cgutils.if_unlikely(builder, cgutils.is_not_null(builder, stored)):
            target = context.call_conv._get_excinfo_argument(builder.function)
            builder.store(builder.inttoptr(stored, target.type.pointee), target)
            context.call_conv._return_errcode_raw(builder, RETCODE_USEREXC)
        return context.get_dummy_value()

    return types.void(signals), generate


# Numba passes the first argument itself, which type checkers cannot see.
_compare_and_swap: Any = intrinsic(_compare_and_swap_code)
_fetch_add_one: Any = intrinsic(_fetch_add_code)
_load_acquire: Any = intrinsic(_load_acquire_code)
_store_release: Any = intrinsic(_store_release_code)
_call_storing_error: Any = intrinsic(_call_storing_error_code)
_raise_stored_error: Any = intrinsic(_raise_stored_error_code)


@jit_inner
def reset_team(team):
    """Reset the state before the threads start: phase 0, with no task claimed."""
    team.signals[:_CLAIMS_INDEX] = 0
    team.signals[_CLAIMS_INDEX:] = -1


@jit_inner
def try_claim(team, task, phase):
    """Return whether this thread has claimed the task of a phase.

    Args:
        team: thread team.
        task: index of the task.
        phase: the phase; a task whose last claim is of this phase, or of a later one, cannot be claimed.
    """
    before = _load_acquire(team.signals, _CLAIMS_INDEX + task)
    return before < phase and _compare_and_swap(team.signals, _CLAIMS_INDEX + task, before, phase)


@jit_inner
def complete_task(team):
    """Mark a task as completed; return whether it was the last one of its phase.

    The thread that gets True must end the phase.
    """
    if _fetch_add_one(team.signals, _DONE_INDEX) < len(team.task_sums) - 1:
        return False
    team.signals[_DONE_INDEX] = 0
    return True


@jit_inner
def release_phase(team, phase):
    """Start a later phase, whose tasks the threads may then claim.

    Args:
        team: thread team.
        phase: the phase, greater than the present one.
    """
    _store_release(team.signals, _PHASE_INDEX, phase)


@jit_inner
def finish_phases(team):
    """End the last phase."""
    _store_release(team.signals, _PHASE_INDEX, _FINISHED)


@jit_inner
def wait_for_phase(team, phase):
    """Wait for the end of a phase.

    Args:
        team: thread team.
        phase: the phase whose tasks this thread could claim.

    Returns:
        The next phase, negative if there is none.
    """
    looks = 0
    now = _load_acquire(team.signals, _PHASE_INDEX)
    while now == phase:
        looks += 1
        if looks > _MAX_SPINS:
            _yield_core()
        now = _load_acquire(team.signals, _PHASE_INDEX)
    return now


@jit_inner
def call_in_thread(team, function, arguments):
    """Call a thread's function; an exception ends the phases of all threads.

    Args:
        team: thread team.
        function: inner kernel that processes tasks of the team.
        arguments: tuple of its arguments.
    """
    if _call_storing_error(team.signals, function, arguments):
        finish_phases(team)


@jit_inner
def raise_thread_error(team):
    """Raise the exception that a thread has raised, if there is one.

    This must be called after the threads have ended.
    """
    _raise_stored_error(team.signals)


@jit_inner
def read_shared(array, index):
    """Return an integer that another thread may write meanwhile, with acquire ordering.

    Args:
        array: shared integers.
        index: index of the integer.
    """
    return _load_acquire(array, index)


@jit_inner
def write_shared(array, index, value):
    """Write an integer that other threads may read meanwhile, with release ordering.

    Args:
        array: shared integers.
        index: index of the integer.
        value: the new integer.
    """
    _store_release(array, index, value)
