"""Command `springbench validate`: compare simulations with closed forms and with published measurements."""

from __future__ import annotations

from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import typer
from springbench.harness.console import get_output_console, print_message
from springbench.harness.errors import InputError, format_allowed_names


def validate(
    solver: Annotated[str, typer.Option(help="Solver, by name, or of a file: ./mine.py:MySolver.")] = "newton",
    case: Annotated[list[str] | None, typer.Option(help="Only this case; may be repeated.")] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the page.")] = Path("results/validation"),
) -> None:
    """Compare simulations with closed forms and textile tests, as a table and a page.

    The exit code is 1 if the discretisation does not explain the error of a closed form.
    """
    from springbench.harness.execution.progress_display import UNIT_COST, RemainingTime, append_remaining
    from springbench.harness.experiments.validation.validation_study import (
        UNEXPLAINED,
        list_case_names,
        validate_solver,
    )
    from springbench.harness.report.validation_page import write_validation_page

    known = list_case_names()
    for name in case or ():
        if name not in known:
            raise InputError(f"--case: got {name!r}; expected {format_allowed_names(name, known)}")
    if output.exists() and not output.is_dir():
        raise InputError(f"--output: {output} is no folder; give the name of one")
    cases = case or known
    pace, began = RemainingTime([UNIT_COST] * len(cases)), list[float]()

    def announce_case(name: str) -> None:
        now = monotonic()
        if began:
            pace.record_run(UNIT_COST, now - began[-1])
        print_message(append_remaining(f"[{len(began)}/{len(cases)}] {name}", pace.estimate_seconds()))
        began.append(now)

    rows = validate_solver(_create_solver(solver), cases, announce_case)
    _print_table(rows)
    output.mkdir(parents=True, exist_ok=True)
    for path in write_validation_page(rows, solver, output):
        print_message(f"written: {path}")
    raise typer.Exit(1 if any(row["verdict"] == UNEXPLAINED for row in rows) else 0)


def _create_solver(name: str) -> Any:
    from springbench.harness.config.solver_parameters import read_solvers
    from springbench.harness.schema.config_document import ConfigDocument
    from springbench.solvers.plugins import plugin_discovery
    from springbench.solvers.registry import SOLVER_TABLE

    document = ConfigDocument(Path("--solver"), {"solvers": [name]})
    found = read_solvers(document)
    if document.mistakes:
        raise document.build_error()
    return plugin_discovery.load_target(SOLVER_TABLE[found[0].name])(**found[0].parameters)


def _print_table(rows: list[dict[str, Any]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    table = Table("case", "quantity", "exact or band", "simulated", "error", "explained", "verdict", box=SIMPLE_HEAD)
    for row in rows:
        if "values" in row:
            numbers = [f"{row['values'][-1]:.6g}", f"{row['errors'][-1]:.1e}", f"{row['explained_error']:.1e}"]
            table.add_row(row["name"], escape(row["quantity"]), f"{row['exact']:.6g}", *numbers, row["verdict"])
        elif "bending_length" in row:
            for key, unit, factor in (("bending_length", "mm", 1e3), ("drape_coefficient", "%", 1.0)):
                low, high, value = (factor * row[key][one] for one in ("low", "high", "value"))
                is_inside = "in band" if low <= value <= high else "outside band"
                name = escape(f"{key.replace('_', ' ')} [{unit}]")
                table.add_row(row["name"], name, f"{low:.3g} to {high:.3g}", f"{value:.3g}", "", "", is_inside)
        else:
            reason = escape(f"{row['verdict']}: {row['remark']}")
            table.add_row(row["name"], escape(row.get("quantity", "")), "", "", "", "", reason)
    get_output_console().print(table)
