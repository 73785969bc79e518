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
from springbench.harness.report.citations import format_citation
from springbench.harness.report.machine_footer import assign_machine_names, build_machine_footer
from springbench.harness.report.number_format import format_quantity, format_time_step
from springbench.harness.report.table_queries import query_table
from springbench.harness.results.quantities import DISSIPATION_CAUSES, SQL_EXPRESSIONS
from springbench.harness.results.run_schema import RUN_SCHEMA


class RunTimes(NamedTuple):
    """One run: identification, status, and its times [ms]; None where the rows lack a value.

    The fields are the columns of `_SUMMARY_QUERY`, in order. The statistics step, lower, upper, least, num_iterations,
    residual, worst_residual, max_strain and strain_p99 are defined in `springbench.harness.results.quantities`.

    Attributes:
        cold, warm: time of the preparation.
        local, global_: median time of one such step.
        termination_reason: the least favourable reason that ended a step's iterations; None if the solver has no
            iteration limit and nothing else ended them.
        preempted: whether steps were interrupted, in any round.
        phases_consistent: whether the phases add up to an iteration.
        roundoff_residual: residuals below it are round-off (`ROUNDOFF_RATIO`) [J^(1/2)].
        reference_distance: the largest over all frames, if every frame was verified.
        modulus_exponent: exponent of the mesh spacing to which the material's modulus is proportional.
        max_stationarity_audit: largest stationarity that the reference evaluator measured, for a solver that does not
            minimise.
        provided_energy: energy provided in all frames [J].
        damping_share, friction_share, integrator_share, solve_share, engine_share: energy dissipated by each cause,
            relative to it.
    """

    run_id: str
    scene: str
    size: int
    solver: str
    machine_id: str | None
    node_id: str | None
    vertices: int | None
    springs: int | None
    status: str
    reason: str | None
    options_json: str
    parameters_json: str | None
    cold: float | None
    warm: float | None
    step: float | None
    lower: float | None
    upper: float | None
    least: float | None
    local: float | None
    global_: float | None
    num_iterations: float | None
    termination_reason: str | None
    residual: float | None
    max_strain: float | None
    strain_p99: float | None
    preempted: bool | None
    phases_consistent: bool | None
    frames: int | None
    integrator: str | None
    time_step: float | None
    error_requested: float | None
    worst_residual: float | None
    roundoff_residual: float | None
    reference_distance: float | None
    modulus_exponent: int | None
    max_stationarity_audit: float | None
    provided_energy: float | None
    damping_share: float | None
    friction_share: float | None
    integrator_share: float | None
    solve_share: float | None
    engine_share: float | None

    @property
    def dissipation_shares(self) -> tuple[float, ...] | None:
        """Shares of the causes `DISSIPATION_CAUSES`; None where they are unknown or no energy was provided."""
        shares = tuple(getattr(self, f"{cause}_share") for cause in DISSIPATION_CAUSES)
        is_known = self.integrator_share is not None or self.engine_share is not None
        return tuple(one or 0.0 for one in shares) if self.provided_energy is not None and is_known else None


ROUNDOFF_RATIO = 1e-12
"""Share of a step's initial residual, and of the square root of the step's largest energy, that may be round-off.

It is the round-off of 1e-16, amplified by the matrix.
"""

_ENERGY_COLUMNS = ", ".join(
    ["residual_initial", *(f"sqrt(abs({name}))" for name in RUN_SCHEMA.names if name.startswith("energy_")), "0.0"]
)

_SUMMARY_QUERY = f"""
select run_id, any_value(scene), any_value("size"), any_value(solver), any_value(machine_id), any_value(node_id),
    any_value(vertices), any_value(springs),
    coalesce(any_value(status) filter (status <> 'ok'), 'ok'), any_value(reason) filter (status <> 'ok'),
    any_value(to_json({{'integrator': integrator, 'dt': time_step, 'guess': initial_guess, 'iterations': max_iterations,
                       'rtol': residual_rtol, 'threads': threads, 'error': error_requested}})),
    any_value(parameters),
    1e3 * min(seconds) filter (phase = 'prepare' and round = 0),
    1e3 * median(seconds) filter (phase = 'prepare' and round > 0),
    {SQL_EXPRESSIONS["step"]}, {SQL_EXPRESSIONS["lower"]}, {SQL_EXPRESSIONS["upper"]}, {SQL_EXPRESSIONS["least"]},
    1e3 * median(seconds) filter (phase = 'local'),
    1e3 * median(seconds) filter (phase = 'global'),
    {SQL_EXPRESSIONS["num_iterations"]},
    arg_min(termination_reason, list_position(['max-iter', 'saddle', 'stalled', 'converged', 'roundoff'],
                                              termination_reason)) filter (
        termination_reason <> 'max-iter'
        or not coalesce(is_substepping, false) and coalesce(num_iterations >= max_iterations, true)),
    {SQL_EXPRESSIONS["residual"]}, {SQL_EXPRESSIONS["max_strain"]}, {SQL_EXPRESSIONS["strain_p99"]},
    bool_or(preempted) filter (phase = 'step'), bool_and(phases_consistent),
    max(frame), any_value(integrator), any_value(time_step), any_value(error_requested),
    {SQL_EXPRESSIONS["worst_residual"]},
    {ROUNDOFF_RATIO} * max(greatest({_ENERGY_COLUMNS})),
    case when bool_and(reference_distance is not null) filter (phase = 'step') then max(reference_distance) end,
    any_value(modulus_exponent), max(stationarity_audit) filter (not is_minimiser),
    {SQL_EXPRESSIONS["provided_energy"]}, {", ".join(SQL_EXPRESSIONS[f"{cause}_share"] for cause in DISSIPATION_CAUSES)}
from rows_of group by run_id order by min(place)
"""


def read_run_times(table: pa.Table) -> list[RunTimes]:
    """Return the runs in a table of rows, in the order of their first rows.

    The rows have the schema `springbench.harness.results.run_schema.RUN_SCHEMA`.
    """
    numbered = table.append_column("place", pa.array(np.arange(len(table))))
    return [RunTimes(*row) for row in query_table(_SUMMARY_QUERY, numbered)]


def _effective_options(run: RunTimes) -> dict[str, Any]:
    """Return a run's options.

    With a requested error, these are only that error and the options that were set.
    """
    options = json.loads(run.options_json)
    return {key: value for key, value in options.items() if value is not None or options["error"] is None}


def label_runs(timed_runs: Sequence[RunTimes]) -> dict[str, str]:
    """Return a label by run id: the solver with its varying settings.

    These are the settings in which the solver's runs of the scene differ. If there are several machines, the label
    includes the machine, so that each label denotes one curve or table row.
    """
    parameters: dict[str, dict[str, Any]] = {run.run_id: json.loads(run.parameters_json or "{}") for run in timed_runs}
    settings = {run.run_id: _effective_options(run) | parameters[run.run_id] for run in timed_runs}
    places = assign_machine_names((run.machine_id, run.node_id) for run in timed_runs)
    on = {run.run_id: places.get((run.machine_id, run.node_id), "unknown") for run in timed_runs if len(places) > 1}
    values: dict[tuple[str, str, str], set[str]] = defaultdict(set)
    stated: dict[tuple[str, str], set[str]] = defaultdict(set)
    for run in timed_runs:
        stated[run.scene, run.solver] |= parameters[run.run_id].keys()
        for key, value in settings[run.run_id].items():
            values[run.scene, run.solver, key].add(str(value))
    for run in timed_runs:  # a parameter that only some runs state has its default value in the others
        own = parameters[run.run_id]
        for key in stated[run.scene, run.solver] - own.keys() if own else ():
            values[run.scene, run.solver, key].add("")
    return {
        run.run_id: ", ".join(
            [run.solver]
            + [
                f"{key} {format_time_step(value) if key == 'dt' else value}"
                for key, value in settings[run.run_id].items()
                if len(values[run.scene, run.solver, key]) > 1
            ]
            + ([f"machine {on[run.run_id]}"] if on else [])
        )
        for run in timed_runs
    }


_NUMBER_HEADINGS = (
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
_DISSIPATION_HEADING = "lost, %\nd/f/i/s"

TABLE_WIDTH = 100
"""Maximum width of a line [characters], unless its numbers need more."""

_MIN_NAME_WIDTH = 12
"""Width at which names of solvers and scenes are folded if space is short [characters]."""

PREEMPTED_NOTE = "! the process was interrupted while steps were timed: its least time is nearest to the truth"
INCONSISTENT_NOTE = "~ local and global, timed alone, do not add up to an iteration within 15 %"
STALE_MARK_NOTE = "† by other code than today's"
DISSIPATION_NOTE = (
    "d/f/i/s: energy lost to damping, friction, integrator and unconverged solves, of that provided; engines: d/f/i+s"
)
"""Meanings of the marks in the table."""
SHARED_TIMING_NOTE = (
    "timed while others ran, up to {} at once, each on cores of its own: slower than alone by what they share"
)


def build_summary_table(timed_runs: Sequence[RunTimes], table: pa.Table, stale_ids: Collection[str] = ()) -> Table:
    """Build a table with one line per run.

    It has the identification, the status and the times [ms], with marks on doubtful values.

    Args:
        timed_runs: runs of the sweep.
        table: its rows.
        stale_ids: ids of runs that were executed by other code than the current version; they are marked.
    """
    names, scenes = label_runs(timed_runs), {run.scene for run in timed_runs}
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
    out.add_column(
        "\nsolver", overflow="fold", min_width=min(_MIN_NAME_WIDTH, max(map(len, names.values()), default=0))
    )
    has_dissipation = any(run.dissipation_shares for run in timed_runs)
    for name in (*_NUMBER_HEADINGS, *((_DISSIPATION_HEADING,) if has_dissipation else ())):
        out.add_column(name, justify="left" if name == "\nstopped" else "right", no_wrap=True)
    for run in timed_runs:
        if not what and (not above or above[-1] != run.scene):
            out.add_section()
            out.add_row("", f"[bold]{escape(run.scene)}[/]")
            above.append(run.scene)
        out.add_row(
            str(run.size) if run.size else "–",
            escape(names[run.run_id]),
            *(_format_number(value, format_quantity) for value in (run.cold, run.warm)),
            _format_number(run.step, format_quantity) + ("!" if run.preempted else ""),
            _format_number(run.least, format_quantity),
            *(
                _format_number(value, format_quantity) + _inconsistency_mark(run, value)
                for value in (run.local, run.global_)
            ),
            _format_number(run.num_iterations, format_quantity),
            _format_ending(run) + ("[yellow]†[/]" if run.run_id in stale_ids else ""),
            _format_number(run.residual, "{:.1e}".format),
            *(
                _format_number(strain, lambda strain: f"{100 * strain:.3g} %")
                for strain in (run.max_strain, run.strain_p99)
            ),
            *([_format_dissipation(run)] if has_dissipation else []),
        )
    marks = {
        DISSIPATION_NOTE: has_dissipation,
        PREEMPTED_NOTE: any(run.preempted for run in timed_runs),
        INCONSISTENT_NOTE: any(_inconsistency_mark(run, run.local) for run in timed_runs),
    }
    shared = [
        n
        for how, n in zip(*(table[c].to_pylist() for c in ("timing", "num_concurrent_runs")), strict=True)
        if how == "shared"
    ]
    marks[STALE_MARK_NOTE] = any(run.run_id in stale_ids for run in timed_runs)
    marks[SHARED_TIMING_NOTE.format(max(shared, default=0))] = bool(shared)
    out.caption = Text(
        "\n".join(
            [
                *(words for words, there in marks.items() if there),
                *_describe_methods(table),
                *build_machine_footer(table),
            ]
        )
    )
    longest = max(map(len, [*names.values(), *scenes]), default=0)
    # Lines longer than a narrow terminal still show their numbers; Rich would replace them by ellipses.
    most = Measurement.get(wide := Console(width=1000), wide.options, out).maximum
    out.width = max(min(most, TABLE_WIDTH), most - max(0, longest - _MIN_NAME_WIDTH))
    return out


def _format_ending(run: RunTimes) -> str:
    """Return the termination reason of a successful run, otherwise its status."""
    return escape(run.termination_reason or "ok") if run.status == "ok" else f"[bold red]{escape(run.status)}[/]"


def _inconsistency_mark(run: RunTimes, value: float | None) -> str:
    """Return the mark of phases that do not add up to an iteration."""
    return "~" if value is not None and run.phases_consistent is False else ""


def _describe_methods(table: pa.Table) -> list[str]:
    """Return the citation of each solver."""
    known = dict(zip(*(table[name].to_pylist() for name in ("solver", "citation")), strict=True))
    solvers: dict[str, list[str]] = defaultdict(list)
    for solver, reference in known.items():
        if reference:
            solvers[reference].append(solver)
    return [f"{', '.join(names)}: {format_citation(reference)}" for reference, names in solvers.items()]


def _format_dissipation(run: RunTimes) -> str:
    """Format the shares of the causes in percent, separated by slashes; an engine has three."""
    if (shares := run.dissipation_shares) is None:
        return "–"
    damping, friction, integrator, solve, engine = (
        f"{round(100 * share)}" if abs(share) < 10 else f"{100 * share:.0e}" for share in shares
    )
    rest = (integrator, solve) if run.engine_share is None else (engine,)
    return "/".join((damping, friction, *rest))


def _format_number(value: Any, words: Callable[[Any], str]) -> str:
    return "–" if value is None else words(value)
