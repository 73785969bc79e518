"""Command `springbench pages`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from springbench.harness.console import print_message, show_activity


def pages(
    root: Annotated[Path, typer.Argument(help="Root of the checkout.")] = Path(),
    check: Annotated[bool, typer.Option("--check", help="Write nothing; exit code 1 if a page is stale.")] = False,
    draw: Annotated[
        bool, typer.Option("--draw", help="With --check: also draw all pictures and compare their pixels.")
    ] = False,
) -> None:
    """Make the pages and pictures that show published results, from their templates.

    The same published set gives the same bytes.
    """
    show_activity("checking the pages" if check else "making the pages")
    from springbench.harness.report.pages.page_files import check_pages, write_pages

    if not check:
        for path in write_pages(root):
            print_message(f"{path} is written")
        return
    stale = check_pages(root, draws_pictures=draw)
    for line in stale:
        print_message(line)
    print_message("run `springbench pages`, and commit what it writes" if stale else "all pages are current")
    raise typer.Exit(1 if stale else 0)
