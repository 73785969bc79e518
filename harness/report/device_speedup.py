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
from springbench.harness.report.number_format import format_count, format_factor
from springbench.harness.report.table_queries import query_table
from springbench.solvers.iteration.device_interface import SIMULATOR_NAME

SIMILAR_TIME_RATIO = 1.05
"""Times within this factor count as equal: neither side is faster."""


class DeviceRun(NamedTuple):
    """One run of a sweep.

    Attributes:
        device_requested: whether the run requested a device.
        vertices: number of vertices; None if the run failed before its scene was built.
        seconds: median wall time of a step [s]; None without timed steps.
        has_converged: whether all steps ended at their tolerance or at round-off.
    """

    computer: str
    scene: str
    size: int
    residual_rtol: float | None
    solver: str
    device_requested: bool
    device: str | None
    vertices: int | None
    status: str
    reason: str | None
    seconds: float | None
    has_converged: bool | None

    @property
    def reached_target(self) -> bool:
        """Whether the steps had a target residual and all of them reached it."""
        return bool(
            self.status == "ok" and self.residual_rtol and self.has_converged and self.vertices and self.seconds
        )


_RUNS_QUERY = """
select coalesce(any_value(machine_id), '') || coalesce(any_value(node_id), ''), any_value(scene), any_value("size"),
    any_value(residual_rtol), any_value(solver), coalesce(any_value(parameters) like '%"device": "cuda"%', false),
    any_value(device), any_value(vertices),
    coalesce(any_value(status) filter (status <> 'ok'), 'ok'), any_value(reason) filter (status <> 'ok'),
    median(seconds) filter (phase = 'step'),
    bool_and(coalesce(termination_reason in ('converged', 'roundoff'), false)) filter (phase = 'step')
from rows_of group by run_id order by any_value("size"), any_value(solver), run_id
"""


class DevicePair(NamedTuple):
    """The fastest run on each side for one residual and one mesh.

    A side is None if none of its runs reached the residual.
    """

    vertices: int
    device_run: DeviceRun | None
    cpu_run: DeviceRun | None

    @property
    def speedup(self) -> float | None:
        """The processor's time divided by the device's; None unless both sides reached the residual."""
        if self.device_run and self.cpu_run and self.device_run.seconds and self.cpu_run.seconds:
            return self.cpu_run.seconds / self.device_run.seconds
        return None


ScenePanel = tuple[str, float]
"""A scene, and the residual tolerance of its steps."""


def read_device_runs(table: pa.Table) -> list[DeviceRun]:
    """Return the runs of a sweep from its rows (schema: `springbench.harness.results.run_schema.RUN_SCHEMA`).

    The list is empty if no run requested a device.
    """
    found = [_mark_simulator_run(DeviceRun(*row)) for row in query_table(_RUNS_QUERY, table)]
    return found if any(run.device_requested for run in found) else []


def _mark_simulator_run(run: DeviceRun) -> DeviceRun:
    """Mark a run in the simulator as unsupported.

    Its times are not those of a device.
    """
    return run._replace(status="unsupported", reason=SIMULATOR_NAME) if run.device == SIMULATOR_NAME else run


def pair_fastest_runs(all_runs: Sequence[DeviceRun]) -> dict[ScenePanel, list[DevicePair]]:
    """Return device pairs by scene and tolerance, in order of the number of vertices.

    Only computers with a successful run on a device count.
    """
    places = {run.computer for run in all_runs if run.device_requested and run.status == "ok"}
    groups: dict[ScenePanel, dict[tuple[str, int], list[DeviceRun]]] = defaultdict(lambda: defaultdict(list))
    for run in all_runs:
        if run.computer in places and run.reached_target:
            groups[run.scene, run.residual_rtol or 0.0][run.computer, run.vertices or 0].append(run)
    order = sorted(groups, key=lambda panel: (panel[0], -panel[1]))
    return {
        panel: sorted((_build_pair(at, mine) for (_, at), mine in groups[panel].items()), key=lambda p: p.vertices)
        for panel in order
    }


def _build_pair(vertices: int, runs_of_mesh: Sequence[DeviceRun]) -> DevicePair:
    there, here = (
        min(
            (run for run in runs_of_mesh if run.device_requested == on),
            key=lambda run: run.seconds or 0.0,
            default=None,
        )
        for on in (True, False)
    )
    return DevicePair(vertices, there, here)


def find_break_even(device_pairs: Sequence[DevicePair]) -> DevicePair | None:
    """Return the smallest mesh from which on the device is faster, or None.

    Only meshes where both sides converged count.
    """
    both = [pair for pair in device_pairs if pair.speedup is not None]
    first = None
    for pair in reversed(both):
        if (pair.speedup or 0.0) <= SIMILAR_TIME_RATIO:
            break
        first = pair
    return first


def summarise_runs(all_runs: Sequence[DeviceRun], config: str) -> list[str]:
    """Summarise runs in sentences; empty if no run of the sweep requested a device.

    Args:
        all_runs: runs of the sweep.
        config: path of the sweep's config; "" if it no longer exists.
    """
    requested = [run for run in all_runs if run.device_requested]
    if not requested:
        return []
    if not any(run.status == "ok" for run in requested):
        return [
            "No run on a device ended well, so nothing is said of what one saves "
            f"({_most_common_reason(requested)}). Where there is a "
            f"device, `.venv/bin/springbench run {config or 'CONFIG'}` fills this in."
        ]
    sentences = [_describe_panel(panel, compared) for panel, compared in pair_fastest_runs(all_runs).items()]
    return [*sentences, *_without_time(requested)]


def _most_common_reason(runs: Sequence[DeviceRun]) -> str:
    """Return the most common reason or status of these runs."""
    return Counter(run.reason or run.status for run in runs).most_common(1)[0][0]


def _describe_panel(panel: ScenePanel, device_pairs: Sequence[DevicePair]) -> str:
    scene, tolerance = panel
    begun = f"{scene}, to {tolerance:g} of the residual at a step's start"
    both = [pair for pair in device_pairs if pair.speedup is not None]
    if not both:
        got = ", ".join(sorted({"the device" if pair.device_run else "the processor" for pair in device_pairs}))
        return f"{begun}: at no size did both sides get there ({got} alone), so nothing is compared."
    first, last = find_break_even(device_pairs), both[-1]
    if first:
        sentence = f"a device pays from {format_count(first.vertices)} vertices on, {_describe_speedup(first)}"
        sentence += f", and {_describe_speedup(last)} at {format_count(last.vertices)}" if last is not first else ""
        sentence += "" if first is not both[0] else ", the smallest that was measured"
    else:
        sentence = (
            f"a device does not pay up to {format_count(last.vertices)} vertices, where "
            f"both got there: {_describe_speedup(last)}"
        )
    alone = [
        f"{format_count(p.vertices)} ({'device' if p.device_run else 'processor'})"
        for p in device_pairs
        if p.speedup is None
    ]
    return f"{begun}: {sentence}" + (f"; one side alone got there at {', '.join(alone)}" if alone else "") + "."


def _describe_speedup(pair: DevicePair) -> str:
    """Describe the speedup of a pair in which both sides converged."""
    assert pair.device_run
    assert pair.cpu_run
    assert pair.speedup is not None
    how = f"takes {format_factor(1 / pair.speedup)} times the time of"
    if pair.speedup > SIMILAR_TIME_RATIO:
        how = f"is {format_factor(pair.speedup)} times as fast as"
    return f"{pair.device_run.solver} there {how} {pair.cpu_run.solver} on the processor"


def _without_time(requested: Sequence[DeviceRun]) -> Iterator[str]:
    """Describe the runs on a device that have no time."""
    failed = [run for run in requested if run.status != "ok"]
    if failed:
        yield f"{len(failed)} of {len(requested)} runs on a device have no time: {_most_common_reason(failed)}."
