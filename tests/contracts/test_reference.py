"""The reference pages are what the code says, and their examples run."""

from __future__ import annotations

import doctest
from pathlib import Path
from types import FunctionType

import pytest
import springbench
from springbench.harness.cli.main import app
from springbench.harness.cli.reference_pages import build_reference_pages, find_stale_pages, write_stale_pages
from springbench.harness.cli.reference_pages.markdown_text import build_anchor, format_docstring, format_table
from springbench.harness.report.opengl_probe import find_opengl_problem
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, find_solver_info, load_target
from typer.main import get_command
from typer.testing import CliRunner

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "configs" / "reference"
MAX_CELL_LENGTH = 60
"""Cells of the table of solvers stay short."""


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return build_reference_pages(get_command(app))


def test_the_pages_are_up_to_date(pages: dict[str, str]) -> None:
    stored = {path.name: path.read_text(encoding="utf-8") for path in FOLDER.glob("*.md") if path.name != "README.md"}
    stale = [name for name in {*pages, *stored} if pages.get(name) != stored.get(name)]
    assert stale == [], "run `springbench reference`"


def test_every_command_column_solver_and_public_name_has_a_place(pages: dict[str, str]) -> None:
    names = [one.name or one.callback.__name__.replace("_", "-") for one in app.registered_commands if one.callback]
    assert all(f"\n## {name}\n" in pages["commands.md"] for name in names)
    assert all(f"\n### {name}\n" in pages["python-api.md"] for name in springbench.__all__)
    assert all(f"| `{name}` |" in pages["solvers.md"] for name in (*SOLVERS, *OPTIONAL_SOLVERS))


@pytest.mark.parametrize("name", [*SOLVERS, *OPTIONAL_SOLVERS])
def test_every_solver_states_its_formula_its_cost_and_its_source(name: str) -> None:
    info = find_solver_info(load_target((SOLVERS | OPTIONAL_SOLVERS)[name]), name)
    assert 0 < len(info.formula) <= MAX_CELL_LENGTH
    assert 0 < len(info.cost) <= MAX_CELL_LENGTH
    assert info.citation


def test_a_stale_page_is_found_and_written_again(pages: dict[str, str], tmp_path: Path) -> None:
    assert [path.name for path in write_stale_pages(pages, tmp_path)] == list(pages)
    assert find_stale_pages(pages, tmp_path) == []
    (tmp_path / "columns.md").write_text("# Columns")
    assert write_stale_pages(pages, tmp_path) == [tmp_path / "columns.md"]
    assert (tmp_path / "columns.md").read_text() == pages["columns.md"]


@pytest.mark.slow
def test_the_command_fails_if_a_page_is_missing(tmp_path: Path) -> None:
    checked = CliRunner().invoke(app, ["reference", str(tmp_path), "--check"])
    assert (checked.exit_code, "columns.md: stale" in checked.output) == (1, True)
    assert list(tmp_path.iterdir()) == []


def test_a_docstring_becomes_text_lists_and_code() -> None:
    text = (
        "Add.\n\nArgs:\n    a: one\n        more.\n    b: 2.\nReturns: a\n    sum.\n\nExample:\n    >>> 1 + 1\n    2\n"
    )
    parts = [
        "Add.",
        "*Args:*",
        "* `a`: one more.\n* `b`: 2.",
        "*Returns:* a sum.",
        "```python\n>>> 1 + 1\n2\n```",
    ]
    assert format_docstring(text) == "\n\n".join(parts)
    assert format_docstring(text, with_arguments=False) == "\n\n".join((parts[0], *parts[3:]))
    assert format_table(("a",), [("b | c\nd",)]) == "| a |\n| --- |\n| b \\| c d |"
    assert build_anchor("The `dense` one: a-b") == "the-dense-one-a-b"


PUBLIC = [name for name in springbench.__all__ if isinstance(getattr(springbench, name), type | FunctionType)]
"""Classes and functions; the other names are types of arrays and of names."""
SIMULATING_EXAMPLES = ["load_scene", "make_scene", "Simulation", "Solution", "Solver"]
READING_EXAMPLES = [
    *("run_config", "load_rows", "read_verified_runs"),
    *("open_recording", "RunRecording", "draw_picture", "view_recording"),
]
"""Names whose examples simulate, and those whose examples read the results of the first one."""


def run_examples(names: list[str]) -> None:
    scope = {"springbench": springbench, "Path": Path}
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for name in names:
        text = getattr(springbench, name).__doc__ or ""
        found = doctest.DocTestParser().get_doctest(text, scope, name, None, 0)
        assert found.examples, name
        scope.update(found.globs)
        found.globs = scope
        runner.run(found, clear_globs=False)
    assert runner.summarize(verbose=False).failed == 0


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_the_examples_of_scenes_and_simulations_run() -> None:
    for name in SIMULATING_EXAMPLES:
        run_examples([name])


@pytest.mark.slow
@pytest.mark.usefixtures("folder", "without_workers")
def test_the_examples_of_runs_and_recordings_run() -> None:
    run_examples([name for name in READING_EXAMPLES if name != "draw_picture" or find_opengl_problem() is None])


@pytest.mark.parametrize("name", sorted({*PUBLIC} - {*SIMULATING_EXAMPLES, *READING_EXAMPLES}))
@pytest.mark.usefixtures("folder")
def test_the_example_of_a_public_name_runs(name: str) -> None:
    run_examples([name])
