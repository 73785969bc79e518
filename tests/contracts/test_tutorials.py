"""Tutorials run as notebooks, and print what their pages show."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest

from tests.tutorial_notebooks import (
    PAGES,
    TutorialCell,
    execute_cells,
    format_notebook,
    iterate_differences,
    read_cells,
    write_cells,
)

QUICK = {"1-the-assignment"}
"""Tutorials of some seconds."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_notebook_is_made_of_the_page(page: Path) -> None:
    cells = read_cells(page.read_text(encoding="utf-8"))
    assert write_cells(cells) == page.read_text(encoding="utf-8")
    stored = page.with_suffix(".ipynb").read_text(encoding="utf-8")
    assert stored == format_notebook(cells), "run `python -m tests.tutorial_notebooks`"
    nbformat.validate(nbformat.reads(stored, as_version=4))


def test_a_page_is_split_into_text_code_and_output() -> None:
    text = "# A\n\n```python\n1 + 1\n```\n\n```text\n2\n```\n\nEnd.\n"
    cells = read_cells(text)
    assert [(cell.source, cell.is_code, cell.output) for cell in cells] == [
        ("# A", False, ""),
        ("1 + 1", True, "2\n"),
        ("End.", False, ""),
    ]
    assert write_cells(cells) == text


def test_another_output_is_found_unless_it_is_measured() -> None:
    expected = [TutorialCell("a", True, "1\n", "text"), TutorialCell("b", True, "2\n", "text measured")]
    found = [TutorialCell("a", True, "0\n", "text"), TutorialCell("b", True, "3\n", "text measured")]
    assert list(iterate_differences(expected, found)) == [("a", "1\n", "0\n")]


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=pytest.mark.slow if page.stem in QUICK else pytest.mark.long) for page in PAGES],
    ids=lambda page: page.stem,
)
def test_a_tutorial_prints_what_its_page_shows(page: Path, tmp_path: Path) -> None:
    cells = read_cells(page.read_text(encoding="utf-8"))
    assert list(iterate_differences(cells, execute_cells(cells, tmp_path))) == []
