"""Kinds of figures: the rows that each needs, its panels, and how they are prepared."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from harness.base.errors import InputError, Mistake, RunFailed, SpringbenchError, did_you_mean
from harness.config.sweep import EVERY_REPORT
from harness.report.figures import (
    of_accuracy,
    of_effects,
    of_engines,
    of_gates,
    of_hard,
    of_meshes,
    of_runs,
    of_winners,
)
from harness.report.figures.entry import Entry, ready
from harness.report.figures.panel import CellMap, Panel, Picture
from solvers.plugins import load


class Kind(NamedTuple):
    """A kind of figure.

    Attributes:
        title: title of the figure.
        wanted: description of the rows that it is drawn from.
        panels: returns the panels of a folder of results by name, given a function that finds stale runs.
        usual: selectors that apply if the command line gives none.
        draw: builds the panels from the selected entries.
    """

    title: str
    wanted: str
    panels: Callable[[Path, of_runs.Older], list[Entry]]
    usual: tuple[tuple[str, ...], ...] = ((),)
    draw: Callable[[Sequence[Entry]], list[Panel]] = lambda entries: [entry.make() for entry in entries]


def _meshes(entries: Sequence[Entry]) -> list[Panel]:
    pictures = [panel for panel in (entry.make() for entry in entries) if isinstance(panel, Picture)]
    return [one for _, of in groupby(pictures, lambda picture: picture.subject) for one in of_meshes.alike(list(of))]


def _sheet(entries: Sequence[Entry]) -> list[Panel]:
    return [*of_meshes.sheet([panel for panel in (e.make() for e in entries) if isinstance(panel, Picture)])]


def _maps(entries: Sequence[Entry]) -> list[Panel]:
    """Merge the families of hard cases into one map."""
    panels = [entry.make() for entry in entries]
    grids = [panel for panel in panels if isinstance(panel, CellMap)]
    rest = [panel for panel in panels if not isinstance(panel, CellMap)]
    return [*rest, *([of_hard.together(grids)] if grids else [])]


def _rows_alone(panels: Callable[[Path], list[Entry]]) -> Callable[[Path, of_runs.Older], list[Entry]]:
    def read(folder: Path, older: of_runs.Older) -> list[Entry]:
        return panels(folder)

    return read


_ACCURACY, _SWEEP = of_accuracy.WANTED, "rows of `springbench run CONFIG`"
_BOTH = (("gap", "time"), ("gap", "iterations"))
_PROFILES = tuple(("performance", gap) for gap in ("1e-1", "1e-3", "1e-6"))

KINDS: dict[str, Kind] = {
    "convergence": Kind("Convergence", _ACCURACY, _rows_alone(of_accuracy.convergence), _BOTH),
    "times": Kind("Time to accuracy", _ACCURACY, _rows_alone(of_accuracy.times), (("alone",), ("over-1",))),
    "winners": Kind("The cheapest way to an error", _ACCURACY, _rows_alone(of_winners.winners)),
    "engines": Kind("Outside engines beside ours", f"{_ACCURACY}, with engines", _rows_alone(of_engines.engines)),
    "work": Kind("Work and precision", _ACCURACY, _rows_alone(of_accuracy.work)),
    "profiles": Kind("Profiles", _ACCURACY, _rows_alone(of_accuracy.profiles), _PROFILES),
    "growth": Kind("Growth with size", _ACCURACY, _rows_alone(of_accuracy.growth)),
    "liu2013": Kind("Liu et al. 2013, reproduced", f"{_ACCURACY}, of liu2013.yaml", _rows_alone(of_accuracy.paper)),
    "timing": Kind("Time a step", _SWEEP, of_runs.timing, (("step",), ("prepare",))),
    "hard": Kind("Hard cases", f"{_SWEEP} with `judge: true`", of_hard.hard, (("shares",),), _maps),
    "ablation": Kind("What effects cost", "rows of `springbench ablate SCENE`", _rows_alone(of_effects.effects)),
    "prices": Kind(
        "The price of effects",
        "rows of `springbench ablate SCENE --all-solvers`",
        _rows_alone(of_effects.prices),
        (("map",),),
    ),
    "speed": Kind("Speed", "rows of `springbench speed CONFIG`", _rows_alone(of_runs.speed), (("step",), ("global",))),
    "run": Kind("The mesh at the end", f"{_SWEEP} with recordings", _rows_alone(of_meshes.run), draw=_meshes),
    "comparison": Kind(
        "Solvers side by side", f"{_SWEEP} with recordings", _rows_alone(of_meshes.comparison), draw=_meshes
    ),
    "scenes": Kind("Scenes at their end", f"{_SWEEP} with recordings", _rows_alone(of_meshes.scenes), draw=_sheet),
    "history": Kind("Results of a gate, by commit", of_gates.WANTED, _rows_alone(of_gates.gates)),
}


def kind(name: str) -> Kind:
    """Find the kind of figure with this name.

    An installed report with a `panels` attribute is a kind too.

    Raises:
        InputError: if there is no such kind.
    """
    if name in KINDS:
        return KINDS[name]
    known = {*KINDS, *(other for other in EVERY_REPORT if other not in EVERY_REPORT.shipped[0])}
    if name not in known:
        raise InputError(Mistake(f"came {name!r}; wanted {did_you_mean(name, known)}", key="KIND"))
    report: Any = load(EVERY_REPORT[name])
    if not callable(getattr(report, "panels", None)):
        why = f"the report {name!r} draws no figure; wanted one that has `panels(rows)`, which returns panels"
        raise InputError(Mistake(why, key="KIND"))
    return Kind(name, _SWEEP, _rows_alone(partial(_own, name, report)))


def _own(name: str, report: Any, folder: Path) -> list[Entry]:
    table = of_runs.sweep_rows(folder)
    try:
        panels: Iterable[Panel] = report.panels(table)
        return ready(panels)
    except (SpringbenchError, OSError):
        raise
    except Exception as error:  # it is somebody's own
        raise RunFailed(f"the report {name} failed: {type(error).__name__}: {error}") from error
