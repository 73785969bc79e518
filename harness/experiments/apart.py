"""Call a function, in a separate process where it runs user code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from harness.base.errors import RunFailed

if TYPE_CHECKING:
    from harness.base.worker import Limits, Tick


def apart(
    piece: Callable[[Tick], Any],
    own: Sequence[object],
    say: Callable[[str], None] = lambda said: None,
    limits: Limits | None = None,
) -> Any:
    """Return the result of a function, isolated if user code is involved.

    Args:
        piece: work to do; picklable; called with a function that reports progress.
        own: plug-ins that the function runs; if empty, it is called in this process.
        say: called with each progress message.
        limits: limits of the process; none if left out.

    Raises:
        RunFailed: the process was lost. Errors of the function are raised unchanged.
    """
    if not own:
        return piece(say)
    from harness.base.asides import is_step
    from harness.base.workers import Limits, Lost, Workers

    workers = Workers()
    try:
        return workers.do(piece, lambda said: say(said) if is_step(said) else None, limits or Limits())
    except Lost as lost:
        raise RunFailed(f"the process that runs {', '.join(map(str, own))} {lost}") from None
    finally:
        workers.end()
