"""What results offer: panels by name, made when they are asked for, and the choice that `--panels` makes of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from harness.base.errors import InputError, Mistake
from harness.report.figures.panel import Panel

MOST = 12
"""Panels of one figure."""
_TOLD = 12
"""Names that a message lists."""


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """A panel that could be drawn. of, name: as `panel.Plot` has them; make: the panel."""

    of: tuple[str, ...]
    name: tuple[str, ...]
    make: Callable[[], Panel]

    @property
    def parts(self) -> tuple[str, ...]:
        """All parts of the name."""
        return (*self.of, *self.name)


def ready(panels: Iterable[Panel]) -> list[Entry]:
    """Entries of panels that are there already."""
    return [Entry(panel.of, panel.name, lambda panel=panel: panel) for panel in panels]


def chosen(entries: Sequence[Entry], selectors: Sequence[tuple[str, ...]]) -> list[Entry]:
    """The entries that the selectors name, in their order; where a selector does not say of what, those of the first.

    A selector names each panel that has all of its parts. Raises InputError for one that names none, and for more
    panels than a figure holds.
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
