"""Summary of each run of a sweep in milliseconds, and its table.

The table is printed at the end of a sweep.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from harness.base.columns import SCHEMA
from harness.base.quantities import SQL
from harness.report.machines import foot
from harness.report.machines import names as machine_names
from harness.report.page import quantity, step_words
from harness.report.references import cited
from harness.report.sql import answer


class RunTimes(NamedTuple):
    """One run: identification, status, and its times [ms]; None where the rows lack a value.

    The fields are the columns of `_SUMMARY`, in order. The statistics step, lower, upper, least, iterations,
    residual, worst_residual, largest_strain and strain_99 are defined in `harness.base.quantities`.

    Attributes:
        cold, warm: time of the preparation.
        local, global_: median time of one such step.
        stopped: the least favourable reason that ended a step's iterations; None if the solver has no
            iteration limit and nothing else ended them.
        interrupted: whether steps were interrupted, in any round.
        adds_up: whether the phases add up to an iteration.
        round_off: residuals below it are round-off (`ROUND_OFF`) [J^(1/2)].
        distance: the largest over all frames, if every frame was verified.
        modulus_exponent: value of the rows.
        left: largest stationarity that the reference evaluator measured, for a solver that does not
            minimise.
    """

    run_id: str
    scene: str
    size: int
    solver: str
    machine: str | None
    node: str | None
    vertices: int | None
    springs: int | None
    status: str
    reason: str | None
    settings: str
    parameters: str | None
    cold: float | None
    warm: float | None
    step: float | None
    lower: float | None
    upper: float | None
    least: float | None
    local: float | None
    global_: float | None
    iterations: float | None
    stopped: str | None
    residual: float | None
    largest_strain: float | None
    strain_99: float | None
    interrupted: bool | None
    adds_up: bool | None
    frames: int | None
    integrator: str | None
    time_step: float | None
    asked: float | None
    worst_residual: float | None
    round_off: float | None
    distance: float | None
    modulus_exponent: int | None
    left: float | None


ROUND_OFF = 1e-12
"""Share of a step's initial residual, and of the square root of the step's largest energy, that may be round-off.

It is the round-off of 1e-16, amplified by the matrix.
"""

_ENERGIES = ", ".join(
    ["yardstick", *(f"sqrt(abs({name}))" for name in SCHEMA.names if name.startswith("energy_")), "0.0"]
)

_SUMMARY = f"""
select run_id, any_value(scene), any_value("size"), any_value(solver), any_value(machine), any_value(node),
    any_value(vertices), any_value(springs),
    coalesce(any_value(status) filter (status <> 'ok'), 'ok'), any_value(reason) filter (status <> 'ok'),
    any_value(to_json({{'integrator': integrator, 'dt': time_step, 'guess': first_guess, 'iterations': max_iterations,
                       'tolerance': tolerance, 'threads': threads, 'asked': asked}})),
    any_value(parameters),
    1e3 * min(seconds) filter (phase = 'prepare' and round = 0),
    1e3 * median(seconds) filter (phase = 'prepare' and round > 0),
    {SQL["step"]}, {SQL["lower"]}, {SQL["upper"]}, {SQL["least"]},
    1e3 * median(seconds) filter (phase = 'local'),
    1e3 * median(seconds) filter (phase = 'global'),
    {SQL["iterations"]},
    arg_min(stopped, list_position(['iterations', 'stalled', 'tolerance', 'floor'], stopped)) filter (
        stopped <> 'iterations' or not coalesce(own_steps, false) and coalesce(iterations >= max_iterations, true)),
    {SQL["residual"]}, {SQL["largest_strain"]}, {SQL["strain_99"]},
    bool_or(interrupted) filter (phase = 'step'), bool_and(adds_up),
    max(frame), any_value(integrator), any_value(time_step), any_value(asked), {SQL["worst_residual"]},
    {ROUND_OFF} * max(greatest({_ENERGIES})),
    case when bool_and(distance is not null) filter (phase = 'step') then max(distance) end,
    any_value(modulus_exponent), max(graded) filter (not minimises)
from rows_of group by run_id order by min(place)
"""


def runs(table: pa.Table) -> list[RunTimes]:
    """Return the runs in a table of rows, in the order of their first rows.

    The rows have the schema `harness.base.columns.SCHEMA`.
    """
    numbered = table.append_column("place", pa.array(np.arange(len(table))))
    return [RunTimes(*row) for row in answer(_SUMMARY, numbered)]


def _stated(run: RunTimes) -> dict[str, Any]:
    """Return a run's options.

    With a requested error, these are only that error and the options that were set.
    """
    options = json.loads(run.settings)
    return {key: value for key, value in options.items() if value is not None or options["asked"] is None}


def labels(found: Sequence[RunTimes]) -> dict[str, str]:
    """Return a label by run id: the solver with its varying settings.

    These are the settings in which the solver's runs of the scene differ. If there are several machines, the label
    includes the machine, so that each label denotes one curve or table row.
    """
    parameters: dict[str, dict[str, Any]] = {run.run_id: json.loads(run.parameters or "{}") for run in found}
    settings = {run.run_id: _stated(run) | parameters[run.run_id] for run in found}
    places = machine_names((run.machine, run.node) for run in found)
    on = {run.run_id: places.get((run.machine, run.node), "unknown") for run in found if len(places) > 1}
    values: dict[tuple[str, str, str], set[str]] = defaultdict(set)
    stated: dict[tuple[str, str], set[str]] = defaultdict(set)
    for run in found:
        stated[run.scene, run.solver] |= parameters[run.run_id].keys()
        for key, value in settings[run.run_id].items():
            values[run.scene, run.solver, key].add(str(value))
    for run in found:  # what some state and others leave out, for they have it as usual
        own = parameters[run.run_id]
        for key in stated[run.scene, run.solver] - own.keys() if own else ():
            values[run.scene, run.solver, key].add("")
    return {
        run.run_id: ", ".join(
            [run.solver]
            + [
                f"{key} {step_words(value) if key == 'dt' else value}"
                for key, value in settings[run.run_id].items()
                if len(values[run.scene, run.solver, key]) > 1
            ]
            + ([f"machine {on[run.run_id]}"] if on else [])
        )
        for run in found
    }


_NUMBERS = (
    "prepare\ncold",
    "\nwarm",
    "\nstep",
    "\nleast",
    "\nlocal",
    "\nglobal",
    "\niter.",
    "\nstopped",
    "resi-\ndual",
    "largest\nstrain",
    "99 %\nbelow",
)

WIDTH = 100
"""Maximum width of a line [characters], unless its numbers need more."""

_NAMES = 12
"""Width at which names of solvers and scenes are folded if space is short [characters]."""

INTERRUPTED = "! the process was interrupted while steps were timed: its least time is nearest to the truth"
APART = "~ local and global, timed alone, do not add up to an iteration within 15 %"
OTHER = "† by other code than today's"
"""Meanings of the marks in the table."""
SHARED = "timed beside others, up to {} at once, each on cores of its own: slower than alone by what they share"


def summary_table(table: pa.Table, other_code: Collection[str] = ()) -> Table:
    """Build a table with one line per run.

    It has the identification, the status and the times [ms], with marks on doubtful values.

    Args:
        table: rows of the sweep.
        other_code: ids of runs that were executed by other code than the current version; they are marked.
    """
    found = runs(table)
    names, scenes = labels(found), {run.scene for run in found}
    what, above = f"{scenes.pop()}: " if len(scenes) == 1 else "", list[str]()
    out = Table(
        title=f"{escape(what)}times in milliseconds, medians over the rounds and over the steps",
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        padding=0,
        pad_edge=False,
    )
    out.add_column("\nsize", justify="right", min_width=4)
    out.add_column("\nsolver", overflow="fold", min_width=min(_NAMES, max(map(len, names.values()), default=0)))
    for name in _NUMBERS:
        out.add_column(name, justify="left" if name == "\nstopped" else "right", no_wrap=True)
    for run in found:
        if not what and (not above or above[-1] != run.scene):
            out.add_section()
            out.add_row("", f"[bold]{escape(run.scene)}[/]")
            above.append(run.scene)
        out.add_row(
            str(run.size) if run.size else "–",
            escape(names[run.run_id]),
            *(_number(value, quantity) for value in (run.cold, run.warm)),
            _number(run.step, quantity) + ("!" if run.interrupted else ""),
            _number(run.least, quantity),
            *(_number(value, quantity) + _apart(run, value) for value in (run.local, run.global_)),
            _number(run.iterations, quantity),
            _ended(run) + ("[yellow]†[/]" if run.run_id in other_code else ""),
            _number(run.residual, "{:.1e}".format),
            *(
                _number(strain, lambda strain: f"{100 * strain:.3g} %")
                for strain in (run.largest_strain, run.strain_99)
            ),
        )
    marks = {INTERRUPTED: any(run.interrupted for run in found), APART: any(_apart(run, run.local) for run in found)}
    shared = [
        n for how, n in zip(*(table[c].to_pylist() for c in ("timing", "at_once")), strict=True) if how == "shared"
    ]
    marks[OTHER] = any(run.run_id in other_code for run in found)
    marks[SHARED.format(max(shared, default=0))] = bool(shared)
    out.caption = Text("\n".join([*(words for words, there in marks.items() if there), *_methods(table), *foot(table)]))
    longest = max(map(len, [*names.values(), *scenes]), default=0)
    # Lines longer than a narrow terminal keep their numbers; Rich would replace them by ellipses.
    most = Measurement.get(wide := Console(width=1000), wide.options, out).maximum
    out.width = max(min(most, WIDTH), most - max(0, longest - _NAMES))
    return out


def _ended(run: RunTimes) -> str:
    """Return the termination reason of a successful run, otherwise its status."""
    return escape(run.stopped or "ok") if run.status == "ok" else f"[bold red]{escape(run.status)}[/]"


def _apart(run: RunTimes, value: float | None) -> str:
    """Return the mark of phases that do not add up to an iteration."""
    return "~" if value is not None and run.adds_up is False else ""


def _methods(table: pa.Table) -> list[str]:
    """Return the citation of each solver."""
    known = dict(zip(*(table[name].to_pylist() for name in ("solver", "reference")), strict=True))
    solvers: dict[str, list[str]] = defaultdict(list)
    for solver, reference in known.items():
        if reference:
            solvers[reference].append(solver)
    return [f"{', '.join(names)}: {cited(reference)}" for reference, names in solvers.items()]


def _number(value: Any, words: Callable[[Any], str]) -> str:
    return "–" if value is None else words(value)
