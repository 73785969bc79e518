"""Reference pages of commands, config keys, columns, API and solvers, generated from their definitions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from springbench.harness.atomic_files import atomic_write
from springbench.harness.cli.reference_pages.api_page import build_api_page
from springbench.harness.cli.reference_pages.column_page import build_column_page
from springbench.harness.cli.reference_pages.command_page import build_command_page
from springbench.harness.cli.reference_pages.config_pages import build_config_pages
from springbench.harness.cli.reference_pages.solver_page import build_solver_page

NOTICE = "`springbench reference` writes this page from the code; a test compares both."
"""Second paragraph of each page."""


def build_reference_pages(command: Any) -> dict[str, str]:
    """Build the texts of the reference pages, by file name.

    Args:
        command: command line, a Typer group.
    """
    pages = {
        "commands.md": build_command_page(command),
        **build_config_pages(),
        "columns.md": build_column_page(),
        "python-api.md": build_api_page(),
        "solvers.md": build_solver_page(),
    }
    return {name: _insert_notice(text) for name, text in pages.items()}


def _insert_notice(text: str) -> str:
    title, first, rest = text.split("\n\n", 2)
    return f"{title}\n\n{first}\n\n{NOTICE}\n\n{rest.strip()}\n"


def find_stale_pages(pages: Mapping[str, str], folder: Path) -> list[Path]:
    """Find the files of pages that are missing or differ from their texts.

    Args:
        pages: texts by file name.
        folder: folder of the files.
    """
    paths = {folder / name: text for name, text in pages.items()}
    return [one for one, text in paths.items() if not one.is_file() or one.read_text(encoding="utf-8") != text]


def write_stale_pages(pages: Mapping[str, str], folder: Path) -> list[Path]:
    """Write the pages whose files are stale, and return their paths.

    Args:
        pages: texts by file name.
        folder: folder of the files, created if missing.

    Raises:
        WriteError: if a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stale = find_stale_pages(pages, folder)
    for path in stale:
        with atomic_write(path) as partial:
            partial.write_text(pages[path.name], encoding="utf-8")
    return stale
