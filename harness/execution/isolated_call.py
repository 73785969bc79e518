"""Call a function; in a separate process if it runs user code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from springbench.harness.errors import RunFailed

if TYPE_CHECKING:
    from springbench.harness.execution.worker_process import ProgressCallback, TaskLimits


def run_isolated(
    function: Callable[[ProgressCallback], Any],
    user_code: Sequence[object],
    limits: TaskLimits,
    print_message: Callable[[str], None] = lambda message: None,
) -> Any:
    """Return the result of a function, isolated if user code is involved.

    Args:
        function: work to do; picklable; called with a function that reports progress.
        user_code: plug-ins that the function runs; if empty, it is called in this process.
        limits: limits of the process.
        print_message: called with each progress message.

    Raises:
        RunFailed: the process was lost. Errors of the function are raised unchanged.
    """
    if not user_code:
        return function(print_message)
    from springbench.harness.execution.isolated_worker import IsolatedWorker, TaskFailure
    from springbench.harness.execution.progress_events import is_step_event

    worker = IsolatedWorker()
    try:
        return worker.run_task(
            function, lambda message: print_message(message) if is_step_event(message) else None, limits
        )
    except TaskFailure as lost:
        raise RunFailed(f"the process that runs {', '.join(map(str, user_code))} {lost}") from None
    finally:
        worker.stop_worker()
