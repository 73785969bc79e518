"""What fits in the machine's memory, so that what does not is refused with its size and before it is begun."""

from __future__ import annotations

import os


def of_machine() -> float:
    """Three quarters of the machine's memory [bytes]: the rest is for what else a run has."""
    return 0.75 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def in_words(count: float) -> str:
    """Bytes in words."""
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if count < 1024 or unit == "GiB":
            break
        count /= 1024
    return f"{count:,.0f} {unit}" if count >= 1000 else f"{count:.3g} {unit}"
