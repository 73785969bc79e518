"""Speedup of a CUDA device over the processor of the same computer.

It compares times to a residual, from the rows of a sweep:

    time(errors, vertices) = min over solvers of the median wall seconds of a step, for runs whose every step converged

Times are compared within one computer. If no run on a device succeeded (runs in the simulator do not count), the
summary states the reason and the command that produces such runs, instead of a speedup.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import pyarrow as pa

from harness.report.page import count, factor
from harness.report.sql import answer
from solvers.device import SIMULATED

ALIKE = 1.05
"""Times within this factor count as equal: neither side is faster."""


class Run(NamedTuple):
    """One run of a sweep.

    Attributes:
        asked: whether the run requested a device.
        vertices: number of vertices; None if the run failed before its scene was built.
        seconds: median wall time of a step [s]; None without timed steps.
        reached: whether all steps ended at their tolerance.
    """

    place: str
    scene: str
    size: int
    tolerance: float | None
    solver: str
    asked: bool
    device: str | None
    vertices: int | None
    status: str
    reason: str | None
    seconds: float | None
    reached: bool | None

    @property
    def got_there(self) -> bool:
        """Whether the steps had a target residual and all of them reached it."""
        return bool(self.status == "ok" and self.tolerance and self.reached and self.vertices and self.seconds)


_RUNS = """
select coalesce(any_value(machine), '') || coalesce(any_value(node), ''), any_value(scene), any_value("size"),
    any_value(tolerance), any_value(solver), coalesce(any_value(parameters) like '%"device": "cuda"%', false),
    any_value(device), any_value(vertices),
    coalesce(any_value(status) filter (status <> 'ok'), 'ok'), any_value(reason) filter (status <> 'ok'),
    median(seconds) filter (phase = 'step'),
    bool_and(coalesce(stopped in ('tolerance', 'floor'), false)) filter (phase = 'step')
from rows_of group by run_id order by any_value("size"), any_value(solver), run_id
"""


class Pair(NamedTuple):
    """The fastest run on each side for one residual and one mesh.

    A side is None if none of its runs reached the residual.
    """

    vertices: int
    there: Run | None
    here: Run | None

    @property
    def ratio(self) -> float | None:
        """The processor's time divided by the device's; None unless both sides reached the residual."""
        if self.there and self.here and self.there.seconds and self.here.seconds:
            return self.here.seconds / self.there.seconds
        return None


Panel = tuple[str, float]
"""A scene, and the residual tolerance of its steps."""


def runs(table: pa.Table) -> list[Run]:
    """Return the runs of a sweep from its rows (schema: `harness.base.columns.SCHEMA`).

    The list is empty if no run requested a device.
    """
    found = [_on_one(Run(*row)) for row in answer(_RUNS, table)]
    return found if any(run.asked for run in found) else []


def _on_one(run: Run) -> Run:
    """Mark a run in the simulator as unsupported.

    Its times are not those of a device.
    """
    return run._replace(status="unsupported", reason=SIMULATED) if run.device == SIMULATED else run


def pairs(found: Sequence[Run]) -> dict[Panel, list[Pair]]:
    """Return device pairs by scene and tolerance, in order of the number of vertices.

    Only computers with a successful run on a device count.
    """
    places = {run.place for run in found if run.asked and run.status == "ok"}
    groups: dict[Panel, dict[tuple[str, int], list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in found:
        if run.place in places and run.got_there:
            groups[run.scene, run.tolerance or 0.0][run.place, run.vertices or 0].append(run)
    order = sorted(groups, key=lambda panel: (panel[0], -panel[1]))
    return {
        panel: sorted((_pair(at, mine) for (_, at), mine in groups[panel].items()), key=lambda p: p.vertices)
        for panel in order
    }


def _pair(vertices: int, mine: Sequence[Run]) -> Pair:
    there, here = (
        min((run for run in mine if run.asked == on), key=lambda run: run.seconds or 0.0, default=None)
        for on in (True, False)
    )
    return Pair(vertices, there, here)


def pays_from(compared: Sequence[Pair]) -> Pair | None:
    """Return the smallest mesh from which on the device is faster, or None.

    Only meshes where both sides converged count.
    """
    both = [pair for pair in compared if pair.ratio is not None]
    first = None
    for pair in reversed(both):
        if (pair.ratio or 0.0) <= ALIKE:
            break
        first = pair
    return first


def told(table: pa.Table, config: str) -> list[str]:
    """Summarise the device runs of a sweep's rows in sentences.

    Args:
        table: rows of the sweep.
        config: path of the sweep's config; "" if it no longer exists.
    """
    return words(runs(table), config)


def words(found: Sequence[Run], config: str) -> list[str]:
    """Summarise runs in sentences; empty if no run of the sweep requested a device.

    Args:
        found: runs of the sweep.
        config: path of the sweep's config; "" if it no longer exists.
    """
    asked = [run for run in found if run.asked]
    if not asked:
        return []
    if not any(run.status == "ok" for run in asked):
        return [
            f"No run on a device ended well, so nothing is said of what one saves ({_why(asked)}). Where there is a "
            f"device, `.venv/bin/springbench run {config or 'CONFIG'}` fills this in."
        ]
    said = [_said(panel, compared) for panel, compared in pairs(found).items()]
    return [*said, *_without_time(asked)]


def _why(runs: Sequence[Run]) -> str:
    """Return the most common reason or status of these runs."""
    return Counter(run.reason or run.status for run in runs).most_common(1)[0][0]


def _said(panel: Panel, compared: Sequence[Pair]) -> str:
    scene, tolerance = panel
    begun = f"{scene}, to {tolerance:g} of the residual at a step's start"
    both = [pair for pair in compared if pair.ratio is not None]
    if not both:
        got = ", ".join(sorted({"the device" if pair.there else "the processor" for pair in compared}))
        return f"{begun}: at no size did both sides get there ({got} alone), so nothing is compared."
    first, last = pays_from(compared), both[-1]
    if first:
        told = f"a device pays from {count(first.vertices)} vertices on, {_faster(first)}"
        told += f", and {_faster(last)} at {count(last.vertices)}" if last is not first else ""
        told += "" if first is not both[0] else ", the smallest that was measured"
    else:
        told = f"a device does not pay up to {count(last.vertices)} vertices, where both got there: {_faster(last)}"
    alone = [f"{count(p.vertices)} ({'device' if p.there else 'processor'})" for p in compared if p.ratio is None]
    return f"{begun}: {told}" + (f"; one side alone got there at {', '.join(alone)}" if alone else "") + "."


def _faster(pair: Pair) -> str:
    """Describe the speedup of a pair in which both sides converged."""
    assert pair.there
    assert pair.here
    assert pair.ratio is not None
    how = f"takes {factor(1 / pair.ratio)} times the time of"
    if pair.ratio > ALIKE:
        how = f"is {factor(pair.ratio)} times as fast as"
    return f"{pair.there.solver} there {how} {pair.here.solver} on the processor"


def _without_time(asked: Sequence[Run]) -> Iterator[str]:
    """Describe the runs on a device that have no time."""
    failed = [run for run in asked if run.status != "ok"]
    if failed:
        yield f"{len(failed)} of {len(asked)} runs on a device have no time: {_why(failed)}."
