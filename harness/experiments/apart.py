"""What a command does itself, and does in a process of its own where it runs code of others."""

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
    """What a piece of work returns; done here where there is no code of others, `own`. It pickles; say: told what it
    ticks. Raises what it raises, and RunFailed where its process is lost."""
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
