"""Panels that results provide, by name and built on demand, and their selection by `--panels`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.charts.figure_panels import FigurePanel

MAX_PANELS = 12
"""Maximum number of panels of a figure."""
_MAX_LISTED = 12
"""Maximum number of names that a message lists."""


@dataclass(frozen=True, slots=True, eq=False)
class PanelEntry:
    """A panel that can be drawn.

    Attributes:
        group, name: as in `figure_panels.CurvePlot`.
        build_panel: returns the panel.
    """

    group: tuple[str, ...]
    name: tuple[str, ...]
    build_panel: Callable[[], FigurePanel]

    @property
    def name_parts(self) -> tuple[str, ...]:
        """All parts of the name."""
        return (*self.group, *self.name)


def entries_from_panels(panels: Iterable[FigurePanel]) -> list[PanelEntry]:
    """Wrap panels that are already built as entries."""
    return [PanelEntry(panel.group, panel.name, lambda panel=panel: panel) for panel in panels]


def select_entries(entries: Sequence[PanelEntry], selectors: Sequence[tuple[str, ...]]) -> list[PanelEntry]:
    """Select the entries that match the selectors, in their order.

    A selector matches each panel whose name has all of its parts. If no part of a selector names a group, only the
    panels of the first matching group are selected.

    Args:
        entries: available panels.
        selectors: parts of panel names.

    Raises:
        InputError: if a selector matches nothing, or if there are too many panels for a figure.
    """
    found: list[PanelEntry] = []
    for selector in selectors or ((),):
        named = [entry for entry in entries if set(selector) <= set(entry.name_parts)]
        if not named:
            raise InputError(
                InputMistake(f"got {':'.join(selector)!r}; expected parts of {_join_names(entries)}", key="--panels")
            )
        if not any(part in entry.group for part in selector for entry in named):
            named = [entry for entry in named if entry.group == named[0].group]
        found += [entry for entry in named if entry not in found]
    if len(found) > MAX_PANELS:
        problem = (
            f"got the names of {len(found)} panels; expected at most {MAX_PANELS}, as parts of {_join_names(entries)}"
        )
        raise InputError(InputMistake(problem, key="--panels"))
    return found


def _join_names(entries: Sequence[PanelEntry]) -> str:
    names = [":".join(entry.name_parts) for entry in entries]
    more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
    return ", ".join(names[:_MAX_LISTED]) + more
