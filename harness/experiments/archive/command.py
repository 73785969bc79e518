"""The commands of `springbench` on results that are there."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from harness.base.console import say
from harness.base.errors import InputError, Mistake

Folder = Annotated[Path, typer.Argument(help="A folder of results, or that of one sweep.")]


def compact(
    results: Folder,
    days: Annotated[float, typer.Option(help="Pack what was written so many days ago or more; 0 is all.")] = 0.0,
) -> None:
    """Pack the rows of many runs into one file. All commands see the same rows before and after."""
    from harness.experiments.archive.compact import compact as pack

    if not 0.0 <= days < 1e6:
        raise InputError(Mistake(f"came {days:g}; wanted a number of days, 0 or more", key="--days"))
    pack(results, say, days=days)
