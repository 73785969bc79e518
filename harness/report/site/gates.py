"""Stored benchmark results for the results page, by commit.

Charts show each benchmark's level and its changes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from harness.base.errors import InputError
from harness.report.gate import Stored, read_stored
from harness.report.history import CHANGED, FEWEST, GateHistory, StoredResult, histories
from harness.report.site.marks import axis, drawn
from harness.report.site.script import number, numbers
from harness.report.style import FASTER, INK, MUTED, SLOWER, Mark

Say = Callable[[str], None]
Chart = dict[str, Any]

_RESULTS, _LEVEL = "results", "their level"
_SLOWER, _FASTER = "slower from here on", "faster from here on"
_MARKS = {
    _RESULTS: Mark(MUTED, "o"),
    _LEVEL: Mark(INK, "s"),
    _SLOWER: Mark(SLOWER, "^"),
    _FASTER: Mark(FASTER, "v"),
}
_NOTE = (
    "Stored results of a benchmark with their 95 % intervals, by commit, and the level of each segment of them: where "
    f"it changed beyond noise there is a triangle. Of fewer than {FEWEST} results nothing is said. "
    f"{CHANGED}: with changes beyond the commit."
)
_KINDS = {
    "gates": ("Gates by commit", "times its yardstick"),
    "gate-times": ("Least times by commit", "ms at the least"),
}


def read(files: Iterable[Path], say: Say) -> list[Stored]:
    """Read stored benchmark results, with a remark on each damaged file."""
    found: list[Stored] = []
    for path in files:
        try:
            found.append(read_stored(path))
        except InputError as error:
            say(f"not on the page: {error}")
    return found


def charts(stored: Sequence[Stored]) -> tuple[dict[str, Chart], list[Chart]]:
    """Build the charts by their ids, and the findings.

    Charts are of ratios and of times; findings are the changes, the largest first.
    """
    found = histories(stored)
    made = {name: _chart(name, [one for one in found if one.ratio == (name == "gates")]) for name in _KINDS}
    return {name: chart for name, chart in made.items() if chart["items"]}, [*_findings(found)]


def made(stored: Sequence[Stored]) -> list[Chart]:
    """Return commits and machines of the results, the newest first."""
    dates: dict[tuple[str, str | None, int], list[str]] = {}
    for one in stored:
        cpu, cores, usable = one.machine
        commit = one.commit_info.id + ("-dirty" if one.commit_info.dirty else "")
        dates.setdefault((commit, cpu, usable or cores or 0), []).append(one.datetime)
    told: list[Chart] = [
        {"machine": None, "cpu": cpu, "cores": cores, "memory_gib": None, "system": None, "commit": commit}
        | {"codes": [], "from": min(when), "to": max(when), "count": len(when)}
        for (commit, cpu, cores), when in dates.items()
    ]
    return sorted(told, key=lambda one: str(one["to"]), reverse=True)


def _chart(name: str, found: Sequence[GateHistory]) -> Chart:
    title, words = _KINDS[name]
    machines = Counter(one.gate for one in found)
    return {
        "title": title,
        "note": _NOTE,
        "filters": ["gate"],
        "shape": "points",
        "x": [axis("commit", "commit", {"type": "category"})],
        "y": [axis("value", words, {})],
        "hover": [["commit", "commit"], ["value", words], ["change", "change of the level"]],
        "items": [item for one in found for item in _items(one, one.machine if machines[one.gate] > 1 else "")],
        "marks": {label: drawn(mark) for label, mark in _MARKS.items()},
        "command": "pytest tests/bench --benchmark-only",
    }


def _items(gate: GateHistory, panel: str) -> Iterable[Chart]:
    """Build the chart items of results, level and changes.

    The level has a gap before each change.
    """
    names = _named(gate.points)
    scale = 1.0 if gate.ratio else 1e3
    same = {"what": gate.gate, "gate": gate.gate, "panel": panel, "parameters": "{}"}
    ends = {f"value{end}": numbers(scale * getattr(p, part) for p in gate.points) for end, part in _ENDS}
    yield same | {"label": _RESULTS, "commit": names} | ends | _by(gate, names)
    stretches = list(zip(gate.starts, (*gate.starts[1:], len(names)), gate.levels, strict=True))
    across = [name for start, end, _ in stretches for name in (names[start], names[end - 1], None)]
    upright = [value for *_, level in stretches for value in (number(scale * level),) * 2 + (None,)]
    yield same | {"label": _LEVEL, "commit": across, "value": upright, "joined": True} | _by(gate, across)
    changes = {at: (level, ratio) for (at, ratio), level in zip(gate.changes, gate.levels[1:], strict=True)}
    for label, slower in ((_SLOWER, True), (_FASTER, False)):
        some = [(at, level, ratio) for at, (level, ratio) in changes.items() if (ratio > 1) == slower]
        if some:
            commits, levels = [names[at] for at, *_ in some], numbers(scale * level for _, level, _ in some)
            told = {"commit": commits, "value": levels, "change": [_percent(ratio) for *_, ratio in some]}
            yield same | {"label": label, "large": True} | told | _by(gate, commits)


def _by(gate: GateHistory, commits: Sequence[str | None]) -> Chart:
    return {"made": [{"commit": commit, "cpu": gate.machine} for commit in commits]}


_ENDS = (("", "value"), ("_low", "low"), ("_high", "high"))


def _named(points: Sequence[StoredResult]) -> list[str]:
    """Return the commits of the points, with a number where a commit was measured repeatedly."""
    seen = Counter[str]()
    names: list[str] = []
    for point in points:
        seen[point.commit] += 1
        names.append(point.commit + (f" ({seen[point.commit]})" if seen[point.commit] > 1 else ""))
    return names


def _findings(found: Sequence[GateHistory]) -> Iterable[Chart]:
    for one in found:
        if one.changes:
            words = ", then ".join(f"{_percent(ratio)} at {one.points[at].commit}" for at, ratio in one.changes)
            plot = "gates" if one.ratio else "gate-times"
            yield {"words": f"{one.gate} changed by {words}.", "plot": plot, "filter": {"gate": one.gate}}
    known = [one for one in found if len(one.points) >= FEWEST]
    still = sum(not one.changes for one in known)
    if not found:
        return
    words = f"{still} of {len(found)} gates show no change beyond noise."
    if few := len(found) - len(known):
        words = f"{words[:-1]}; {few} have fewer than the {FEWEST} results that it takes to tell."
    yield {"words": words}


def _percent(ratio: float) -> str:
    return f"{100 * (ratio - 1):+.1f} %"
