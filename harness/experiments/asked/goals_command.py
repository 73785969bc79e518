"""`springbench goals`: time for the same error, beside what was there before."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness.base.commands import Results
from harness.base.console import out, say


def goals(
    config: Annotated[Path, typer.Argument(help="Goals (YAML).")],
    results: Results = Path("results"),
) -> None:
    """Hold the cheapest way to an error against a peer, or against the best steps of one length."""
    from rich.table import Table

    from harness.base import machine, rows
    from harness.base.claim import claimed
    from harness.config.goals import load_goals
    from harness.experiments.accuracy.accuracy_rows import SCHEMA
    from harness.experiments.asked.goals import Met, met
    from harness.experiments.asked.peers import PEERS
    from harness.experiments.provenance import provenance
    from solvers.registry import EVERY

    asked = load_goals(config, list(PEERS), list(EVERY))
    folder = claimed(results / asked.name, config)
    table = Table("", "error", "way", "against", "times its cost", "wanted", "")
    found = list[Met]()
    with machine.pinned_threads(1):
        for one in met(asked, say):
            found.append(one)
            wanted = f"1/{1 / one.goal.wanted:.2g}"
            ratio = f"1/{1 / one.ratio:.3g}" if not one.reason else "–"
            verdict = one.reason or ("holds" if one.holds else "does not hold")
            cells = f"{one.scene} {one.size or ''}", f"{one.goal.error:g}", one.way, one.other, ratio, wanted, verdict
            say(f"  {ratio} of the processor time, wanted {wanted}: {verdict}")
            table.add_row(*cells)
    (folder / "accuracy").mkdir(exist_ok=True)
    shared = {"kind": "goal", "sweep": asked.name, "threads": 1} | provenance()
    written = [
        shared
        | {"status": "failed" if one.reason else "ok", "reason": one.reason or None, "scene": one.scene}
        | {"size": one.size, "vertices": one.vertices, "horizon": one.goal.horizon, "asked": one.goal.error}
        | {"solver": one.way, "estimated": one.estimated, "cpu_seconds": one.seconds, "against": one.other}
        | {"against_error": one.other_error, "against_seconds": one.other_seconds, "wanted": one.goal.wanted}
        for one in found
    ]
    rows.write(folder / "accuracy" / "goals.parquet", written, SCHEMA)
    out().print(table)
    say(f"rows are in {folder / 'accuracy'}")
    raise typer.Exit(0 if all(one.holds for one in found) else 1)
