"""Panels that results provide, by name and built on demand, and their selection by `--panels`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from harness.base.errors import InputError, Mistake
from harness.report.figures.panel import Panel

MOST = 12
"""Maximum number of panels of a figure."""
_TOLD = 12
"""Maximum number of names that a message lists."""


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """A panel that can be drawn.

    Attributes:
        of, name: as in `panel.Plot`.
        make: returns the panel.
    """

    of: tuple[str, ...]
    name: tuple[str, ...]
    make: Callable[[], Panel]

    @property
    def parts(self) -> tuple[str, ...]:
        """All parts of the name."""
        return (*self.of, *self.name)


def ready(panels: Iterable[Panel]) -> list[Entry]:
    """Wrap panels that are already built as entries."""
    return [Entry(panel.of, panel.name, lambda panel=panel: panel) for panel in panels]


def chosen(entries: Sequence[Entry], selectors: Sequence[tuple[str, ...]]) -> list[Entry]:
    """Select the entries that match the selectors, in their order.

    A selector matches each panel whose name has all of its parts. If no part of a selector names a group, only the
    panels of the first matching group are selected.

    Args:
        entries: available panels.
        selectors: parts of panel names.
    Raises:
        InputError: if a selector matches nothing, or if there are too many panels for a figure.
    """
    found: list[Entry] = []
    for selector in selectors or ((),):
        named = [entry for entry in entries if set(selector) <= set(entry.parts)]
        if not named:
            raise InputError(
                Mistake(f"came {':'.join(selector)!r}; wanted parts of {_listed(entries)}", key="--panels")
            )
        if not any(part in entry.of for part in selector for entry in named):
            named = [entry for entry in named if entry.of == named[0].of]
        found += [entry for entry in named if entry not in found]
    if len(found) > MOST:
        wanted = f"came the names of {len(found)} panels; wanted at most {MOST}, as parts of {_listed(entries)}"
        raise InputError(Mistake(wanted, key="--panels"))
    return found


def _listed(entries: Sequence[Entry]) -> str:
    names = [":".join(entry.parts) for entry in entries]
    more = f" and {len(names) - _TOLD} more" if len(names) > _TOLD else ""
    return ", ".join(names[:_TOLD]) + more
