"""Tutorials: pages with code and its outputs, and the notebooks that are made of them.

A page is the source. A fence `python` is a cell; the fence `text` that follows it contains what it prints. Outputs in a
fence `text measured` depend on the machine: they are written, and not compared.

    python -m tests.tutorial_notebooks [PAGE ...]      executes pages, and writes their outputs and notebooks
    python -m tests.tutorial_notebooks --no-execute    writes the notebooks of all pages, after a change of their text
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Any

import nbformat

FOLDER = Path(__file__).resolve().parents[1] / "configs" / "tutorials"
PAGES = sorted(page for page in FOLDER.glob("[0-9]-*.md"))
MEASURED_FENCE = "text measured"
TIMEOUT_SECONDS = 900
_FENCE = re.compile(r"^```(python|text(?: measured)?)\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


@dataclass
class TutorialCell:
    """A part of a page: text, or code with the output that the page shows."""

    source: str
    is_code: bool
    output: str = ""
    output_fence: str = field(default="")


def read_cells(text: str) -> list[TutorialCell]:
    """Split a page into its cells."""
    cells: list[TutorialCell] = []
    end = 0
    for found in _FENCE.finditer(text):
        if between := text[end : found.start()].strip():
            cells.append(TutorialCell(between, is_code=False))
        if found[1] == "python":
            cells.append(TutorialCell(found[2].rstrip(), is_code=True))
        else:
            assert cells[-1].is_code, "an output follows no code"
            cells[-1].output, cells[-1].output_fence = found[2], found[1]
        end = found.end()
    if rest := text[end:].strip():
        cells.append(TutorialCell(rest, is_code=False))
    return cells


def write_cells(cells: list[TutorialCell]) -> str:
    """Write cells as a page."""
    return "\n".join(_write_cell(cell) for cell in cells)


def _write_cell(cell: TutorialCell) -> str:
    if not cell.is_code:
        return f"{cell.source}\n"
    output = f"\n```{cell.output_fence or 'text'}\n{cell.output}```\n" if cell.output or cell.output_fence else ""
    return f"```python\n{cell.source}\n```\n{output}"


def build_notebook(cells: list[TutorialCell]) -> Any:
    """Build the notebook of a page, with the outputs that the page shows."""
    made: list[Any] = []
    for number, cell in enumerate(cells, 1):
        if cell.is_code:
            shown = [nbformat.v4.new_output("stream", name="stdout", text=cell.output)] if cell.output else []
            one = nbformat.v4.new_code_cell(cell.source, outputs=shown)
        else:
            one = nbformat.v4.new_markdown_cell(cell.source)
        one["id"] = f"cell-{number}"
        made.append(one)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return nbformat.v4.new_notebook(cells=made, metadata={"kernelspec": kernel, "language_info": {"name": "python"}})


def format_notebook(cells: list[TutorialCell]) -> str:
    """Format the notebook of a page as the text of its file."""
    return nbformat.writes(build_notebook(cells)) + "\n"


def execute_cells(cells: list[TutorialCell], folder: Path) -> list[TutorialCell]:
    """Execute a page in a kernel of its own, in a folder, and return its cells with the outputs of this run."""
    from nbclient import NotebookClient

    notebook = build_notebook(cells)
    NotebookClient(
        notebook,
        timeout=TIMEOUT_SECONDS,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
    ).execute()
    return [
        TutorialCell(cell.source, cell.is_code, _read_output(one), cell.output_fence)
        for cell, one in zip(cells, notebook.cells, strict=True)
    ]


def _read_output(cell: Any) -> str:
    """Read what a cell printed."""
    printed = [one["text"] for one in cell.get("outputs", ()) if one.get("name") == "stdout"]
    return "".join(printed)


def iterate_differences(expected: list[TutorialCell], found: list[TutorialCell]) -> Iterator[tuple[str, str, str]]:
    """Yield code, expected and found output of cells that print something else than the page shows."""
    for one, other in zip(expected, found, strict=True):
        if one.output_fence != MEASURED_FENCE and one.output != other.output:
            yield one.source, one.output, other.output


def main() -> None:
    """Execute the named pages, or all, and write their outputs and notebooks."""
    names = [name for name in sys.argv[1:] if name != "--no-execute"]
    for page in [Path(name) for name in names] or PAGES:
        cells = read_cells(page.read_text(encoding="utf-8"))
        if "--no-execute" not in sys.argv:
            cells = _execute_page(cells, page)
        page.with_suffix(".ipynb").write_text(format_notebook(cells), encoding="utf-8")
        print(page)


def _execute_page(cells: list[TutorialCell], page: Path) -> list[TutorialCell]:
    with TemporaryDirectory() as folder:
        executed = execute_cells(cells, Path(folder))
        for picture in Path(folder).glob("pictures/*.png"):
            (page.parent / "pictures").mkdir(exist_ok=True)
            copyfile(picture, page.parent / "pictures" / picture.name)
    page.write_text(write_cells(executed), encoding="utf-8")
    return executed


if __name__ == "__main__":
    main()
