"""Command `springbench goals`: compare the time to an error with a baseline."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import Annotated

import typer

from harness.base.commands import Results
from harness.base.console import narrow, out, say


def goals(
    config: Annotated[Path, typer.Argument(help="Goals (YAML).")],
    results: Results = Path("results"),
) -> None:
    """Measure performance targets: the cheapest method for an error, against a baseline."""
    from rich.table import Table

    from harness.base import machine, rows
    from harness.base.claim import claimed
    from harness.config.goals import load_goals
    from harness.experiments.accuracy.accuracy_rows import SCHEMA
    from harness.experiments.accuracy.units import references
    from harness.experiments.asked.goals import Met, met
    from harness.experiments.asked.libraries import LIBRARIES
    from harness.experiments.provenance import provenance
    from solvers.registry import EVERY

    asked = load_goals(config, list(LIBRARIES), list(EVERY))
    folder = claimed(results / asked.name, config)
    table = Table("", "asked", "error", "way", "against", "times its cost", "wanted", "")
    found = list[Met]()
    with machine.pinned_threads(1):
        for one in met(asked, references(results), say):
            found.append(one)
            wanted, ratio = _part(one.asked.goal.wanted), "–" if one.reason else _part(one.ratio, at_most=one.bound)
            verdict = one.reason or ("holds" if one.holds else "does not hold") + (f": {one.note}" if one.note else "")
            error = f"{one.estimated:.1g} estimated" if one.error is None else f"{one.error:.2g}"
            say(f"  an error of {error}, {ratio} of the processor time, wanted {wanted}: {verdict}")
            cells = f"{one.asked.scene} {one.size or ''}", f"{one.asked.error:g}", "" if one.reason else error, one.way
            table.add_row(*cells, one.other, ratio, wanted, verdict)
    (folder / "accuracy").mkdir(exist_ok=True)
    shared = {"kind": "goal", "sweep": asked.name, "threads": 1} | provenance()
    written = [
        shared
        | {
            "status": "failed" if one.reason else "ok",
            "reason": one.reason or one.note or None,
            "scene": one.asked.scene,
        }
        | {"error": one.error}
        | {"size": one.size, "vertices": one.vertices, "horizon": one.asked.goal.horizon, "asked": one.asked.error}
        | {"solver": one.way, "estimated": one.estimated, "cpu_seconds": one.seconds, "against": one.other}
        | {
            "against_error": one.other_error if isfinite(one.other_error) else None,
            "against_seconds": one.other_seconds,
            "wanted": one.asked.goal.wanted,
        }
        for one in found
    ]
    rows.write(folder / "accuracy" / "goals.parquet", written, SCHEMA)
    out().print(narrow(table))
    say(f"rows are in {folder / 'accuracy'}")
    raise typer.Exit(0 if all(one.holds for one in found) else 1)


def _part(ratio: float, *, at_most: bool = False) -> str:
    """Format a ratio of costs."""
    told = f"1/{1 / ratio:.3g}" if ratio < 1.0 else f"{ratio:.3g}"
    return f"at most {told}" if at_most else told
