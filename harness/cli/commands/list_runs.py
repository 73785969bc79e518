"""Command `springbench list`: runs with status, or all solvers, integrators, effects and meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from textwrap import fill, shorten
from typing import TYPE_CHECKING, Annotated, Any

import typer
from springbench.harness.cli.shared_options import ResultsOption, describe_config
from springbench.harness.console import CONSOLE_WIDTH, format_plain_table
from springbench.harness.errors import InputError

if TYPE_CHECKING:
    from springbench.harness.config.sweep_config import RunSpec

_FIXED_COLUMNS = ("max_iterations", "frames", "threads")
"""Options that always have a column, even if all runs agree in them."""


def list_command(
    config: Annotated[
        Path | None,
        describe_config(
            "[CONFIG]",
            "Sweep or scene (YAML), or scene of the assignment (JSON), or name of a shipped config; lists names by "
            "default.",
        ),
    ] = None,
    results: ResultsOption = Path("results"),
    shipped: Annotated[bool, typer.Option("--shipped", help="List the shipped configs and scenes by name.")] = False,
) -> None:
    """Check a config and list its runs with their status.

    Without a config, list all solvers, effects and meshes.
    """
    if shipped:
        if config is not None:
            raise InputError("--shipped: lists all shipped configs; leave the config out")
        _print_shipped_configs()
    elif config is None:
        from springbench.harness.cli.source_texts import print_names

        print_names()
    else:
        _print_runs(config, results)


def _print_shipped_configs() -> None:
    """Print shipped configs and scenes with descriptions, then the names of those in other folders."""
    from springbench.harness.config.config_loader import ACCURACY, SCENE, find_config_kind
    from springbench.harness.config.shipped_configs import SCENE_FOLDER, list_shipped_configs
    from springbench.harness.schema.yaml_loader import read_yaml

    described: dict[str, dict[str, str]] = {"sweeps": {}, "accuracy configs": {}, "scenes": {}}
    others: dict[str, list[str]] = {}
    for name, path in list_shipped_configs().items():
        folder, _, stem = name.rpartition("/")
        if folder not in ("", SCENE_FOLDER):
            others.setdefault(f"scenes of {folder}", []).append(name)
            continue
        data = read_yaml(path).data
        kind = find_config_kind(data)
        heading = "scenes" if kind == SCENE else "accuracy configs" if kind == ACCURACY else "sweeps"
        described[heading][stem] = " ".join(str(data.get("description", "")).split())
    for heading, entries in described.items():
        print(f"\n{heading}, {len(entries)}")
        width = max(map(len, entries))
        for name, description in entries.items():
            print(f"  {name:{width}}  {shorten(description, CONSOLE_WIDTH - width - 4, placeholder=' ...')}".rstrip())
    for heading, names in others.items():
        print(f"\n{heading}, {len(names)}")
        print(
            fill(", ".join(names), CONSOLE_WIDTH, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
        )
    print("\neach is run by its name: `springbench run quickstart`, or in a sweep `scenes: [hanging-cloth]`")


def _print_runs(config: Path, results: Path) -> None:
    from springbench.harness.config.config_loader import load_config
    from springbench.harness.execution.machine_info import describe_machine
    from springbench.harness.experiments.sweep_plan import plan_runs

    sweep = load_config(config, imports_code=False)
    planned = plan_runs(sweep.list_runs(), results / sweep.name)
    columns = collect_varied_settings([p.run for p in planned])
    lines: list[tuple[str, ...]] = [("run", "scene", "size", "solver", *columns, "state")]
    for number, p in enumerate(planned):
        there = p.completion_status
        state = (
            there.status
            + (" (by other code)" if there.is_stale else "")
            + (" (damaged)" if there.damage_reason else "")
        )
        values = (values[number] for values in columns.values())
        what = p.run.scene_name, str(p.run.size), p.run.solver.name
        lines.append((p.files.rows_path.stem[-12:], *what, *values, state))
    for line in format_plain_table(lines):
        print(line)
    print(f"states are those on this machine, {describe_machine().machine_id:.6}; settings are for any")


def collect_varied_settings(runs: Sequence[RunSpec]) -> dict[str, list[str]]:
    """Return the options and solver parameters that distinguish runs of one scene, size and solver.

    Args:
        runs: runs of one sweep.

    Returns:
        A value for each run by column; empty for a parameter that the run's solver does not have.
    """
    from springbench.harness.config.run_options import RUN_OPTIONS

    groups: dict[tuple[str, int, str], list[RunSpec]] = {}
    for run in runs:
        groups.setdefault((run.scene_name, run.size, run.solver.name), []).append(run)

    def has_several_values(value: Callable[[RunSpec], Any]) -> bool:
        return any(len({repr(value(run)) for run in group}) > 1 for group in groups.values())

    values: dict[str, Callable[[RunSpec], Any]] = {name: attrgetter(name) for name in RUN_OPTIONS}
    columns = {name: value for name, value in values.items() if name in _FIXED_COLUMNS or has_several_values(value)}
    for key in sorted({key for run in runs for key in run.solver.parameters}):
        parameter = partial(_get_parameter, key)
        if has_several_values(parameter):
            columns[key] = parameter
    return {
        name: ["" if (cell := value(run)) is None else str(cell) for run in runs] for name, value in columns.items()
    }


def _get_parameter(key: str, run: RunSpec) -> Any:
    return run.solver.parameters.get(key)
