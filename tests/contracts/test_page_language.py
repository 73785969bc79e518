"""Pages are short, in the terms of the field, with links that lead somewhere and commands that exist."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from shutil import copyfile
from typing import Any, NamedTuple

import pytest
import typer
from springbench.harness.cli.main import app
from springbench.harness.cli.reference_pages.markdown_text import build_anchor
from springbench.harness.experiments.ablation.ablation_schema import ABLATION_SCHEMA
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.results.parquet_rows import write_rows
from springbench.harness.results.run_schema import RUN_SCHEMA
from typer.main import get_command
from typer.testing import CliRunner

from tests.architecture.test_vocabulary import DIALECT

ROOT = Path(__file__).resolve().parents[2]
GENERATED_FOLDER = ROOT / "configs" / "reference"
GUIDES = [ROOT / "configs" / folder for folder in ("howto", "explanation", "tutorials")]
HIDDEN_FOLDERS = {".venv", ".pytest_cache", "node_modules", ".ipynb_checkpoints"}
SHIPPED_RESULTS = {"findings", "published"}


def is_shipped(page: Path) -> bool:
    """Return whether a page is part of the project: reports of own results, which git ignores, are not."""
    parts = page.relative_to(ROOT).parts
    is_own_result = parts[0] == "results" and len(parts) > 2 and parts[1] not in SHIPPED_RESULTS
    return not HIDDEN_FOLDERS & set(parts) and not is_own_result


PAGES = sorted(page for page in ROOT.glob("**/*.md") if is_shipped(page))
WRITTEN_PAGES = [page for page in PAGES if page.parent != GENERATED_FOLDER]
"""Pages that people write."""
MAX_PAGE_WORDS = 1500
MAX_FIRST_PAGE_WORDS = 700
MAX_TOTAL_WORDS = 15_000
"""Words of prose on all pages: what a newcomer can read; code, tables and generated reference are extra."""
MAX_MEAN_WORDS = 22
MAX_SENTENCE_WORDS = 40
BANNED_WORDS = (DIALECT - {"oracle", "goals", "blame"}) | {"asked", "wanted", "reckoned", "nothing whatever"}
"""Words of the dialect, as in `tests.architecture.test_vocabulary`; pages may name the folder `tests/oracles`."""
LINK = re.compile(r"\]\(([^)\s]+)\)")


def name_page(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def remove_code(text: str) -> str:
    """Remove fenced and indented code, and markup of links and code within a line."""
    text = re.sub(r"^```.*?^```", "\n", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"(?:^|(?<=\n\n))(?: {4}[^\n]*\n)+", "\n", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return re.sub(r"`([^`]*)`", lambda found: found[1].replace(".", "_").replace(" ", "_"), text)


def split_sentences(text: str) -> list[str]:
    """Split the prose of a page into sentences; headings and tables are none."""
    blocks: list[str] = [""]
    for line in remove_code(text).splitlines():
        if not line.strip() or line.startswith(("#", "|", "<!--")):
            blocks.append("")
        elif re.match(r"\s*([*-]|\d+\.) ", line):
            blocks.append(re.sub(r"^\s*([*-]|\d+\.) ", "", line))
        else:
            blocks[-1] += f" {line.strip()}"
    sentences = (one for block in blocks for one in re.split(r"(?<=[.?!:])\s+(?=[\"'(*_A-Z0-9])", block.strip()))
    return [one for one in sentences if count_words(one)]


def count_words(text: str) -> int:
    return len(re.findall(r"[^\W_][\w'’./-]*", text))


@pytest.mark.parametrize("page", WRITTEN_PAGES, ids=name_page)
def test_sentences_of_a_page_are_short(page: Path) -> None:
    sentences = split_sentences(page.read_text(encoding="utf-8"))
    lengths = [count_words(one) for one in sentences]
    assert [one for one, length in zip(sentences, lengths, strict=True) if length > MAX_SENTENCE_WORDS] == []
    assert sum(lengths) < MAX_MEAN_WORDS * max(len(lengths), 1)


@pytest.mark.parametrize("page", WRITTEN_PAGES, ids=name_page)
def test_a_page_uses_the_terms_of_the_field(page: Path) -> None:
    words = {word.lower() for word in re.findall(r"[^\W\d_]+", remove_code(page.read_text(encoding="utf-8")))}
    assert words & BANNED_WORDS == set()


@pytest.mark.parametrize("page", WRITTEN_PAGES, ids=name_page)
def test_a_page_is_short(page: Path) -> None:
    limit = MAX_FIRST_PAGE_WORDS if page.parent == ROOT else MAX_PAGE_WORDS
    assert len(page.read_text(encoding="utf-8").split()) <= limit


def test_all_pages_together_are_short() -> None:
    texts = (page.read_text(encoding="utf-8") for page in WRITTEN_PAGES)
    assert sum(count_words(sentence) for text in texts for sentence in split_sentences(text)) <= MAX_TOTAL_WORDS


@pytest.mark.parametrize("page", [page for page in PAGES if page.parent in (GENERATED_FOLDER, *GUIDES)], ids=name_page)
def test_the_first_line_states_the_readers_of_the_page(page: Path) -> None:
    text = re.sub(r"\A<!-- Made by .*-->\n", "", page.read_text(encoding="utf-8"))
    title, first = text.split("\n\n")[:2]
    assert title.startswith("# ")
    assert first.startswith("For ")
    assert ": " in first


def find_anchors(page: Path) -> set[str]:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = [
        re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", one) for one in re.findall(r"^#+ (.+?)\s*$", text, re.MULTILINE)
    ]
    return {build_anchor(heading) for heading in headings}


def find_dead_links(page: Path) -> list[str]:
    """Find the links of a page to files or headings that are not there."""
    found = []
    for target in LINK.findall(
        re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    ):
        file, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        path = (page.parent / file).resolve() if file else page
        if not path.exists() or (anchor and path.suffix == ".md" and anchor not in find_anchors(path)):
            found.append(target)
    return found


@pytest.mark.parametrize("page", PAGES, ids=name_page)
def test_every_link_and_anchor_of_a_page_is_there(page: Path) -> None:
    assert find_dead_links(page) == []


class PageCommand(NamedTuple):
    """A command in a fence of a page."""

    page: Path
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{name_page(self.page)}: {' '.join(self.words)[:60]}"


def find_commands(page: Path) -> Iterator[PageCommand]:
    """Yield the commands `springbench ...` in the fences of a page, one for each brace alternative of the shell."""
    for block in re.findall(
        r"^```(?:sh|bash|console)\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        for line in re.sub(r"\\\n\s*", " ", block).splitlines():
            for part in re.split(r"\s*(?:&&|\|\|)\s*", line):
                words = shlex.split(part, comments=True)
                while words and "=" in words[0]:
                    words.pop(0)
                if words and Path(words[0]).name == "springbench":
                    yield PageCommand(page, tuple(words[1:]))


COMMANDS = [one for page in WRITTEN_PAGES for one in find_commands(page)]


@cache
def find_command(name: str) -> Any:
    """Return a command with all of its options, or None."""
    group: Any = get_command(app)
    found = group.get_command(typer.Context(group, info_name="springbench"), name)
    if found:
        found.get_params(typer.Context(found))  # adds the options of runs
    return found


@pytest.mark.parametrize("command", COMMANDS, ids=str)
def test_a_command_of_a_page_exists_with_its_options(command: PageCommand) -> None:
    name, *arguments = command.words
    found = find_command(name)
    assert found, name
    parser = found.make_parser(typer.Context(found, info_name=name))
    parser.parse_args([word for word in arguments if not word.startswith("[")])


@pytest.mark.parametrize("page", WRITTEN_PAGES, ids=name_page)
def test_a_command_in_a_sentence_exists_with_its_options(page: Path) -> None:
    for span in re.findall(r"`springbench ([a-z-]+)([^`]*)`", page.read_text(encoding="utf-8")):
        found = find_command(span[0])
        assert found, span[0]
        known = {name for one in found.params for name in (*one.opts, *getattr(one, "secondary_opts", ()))}
        assert set(re.findall(r"(?<=\s)--[a-z-]+", span[1])) - {"--help"} <= known


@pytest.mark.parametrize("command", [one for one in COMMANDS if "*" not in str(one.words)], ids=str)
def test_the_files_of_a_command_are_there(command: PageCommand) -> None:
    named = [word for word in command.words if re.match(r"(configs|tests|solvers|harness)/[\w./-]+$", word)]
    assert [word for word in named if not (ROOT / word).exists()] == []


QUICK = {"list", "schema", "query"}
"""Commands that take a second."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the configs and with a row of each table, in which commands run."""
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    row = {"scene": "chain", "size": 4, "solver": "sparse", "status": "ok"}
    for table, schema, kind in (
        ("rows", RUN_SCHEMA, {"phase": "step", "seconds": 0.5}),
        ("accuracy", ACCURACY_SCHEMA, {"kind": "work", "error": 0.5}),
        ("ablation", ABLATION_SCHEMA, {"kind": "ablated", "added_seconds": 0.5}),
    ):
        (tmp_path / "results" / "study" / table).mkdir(parents=True)
        write_rows(tmp_path / "results" / "study" / table / "a.parquet", [row | kind], schema)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("command", [one for one in COMMANDS if one.words[0] in QUICK], ids=str)
def test_a_quick_command_of_a_page_runs(command: PageCommand, folder: Path) -> None:
    for path in (*command.page.parent.glob("*.yaml"), *command.page.parent.glob("*.py")):  # files next to the page
        copyfile(path, folder / path.name)
    outcome = CliRunner().invoke(app, list(command.words))
    assert outcome.exit_code == 0, outcome.output


@pytest.mark.parametrize("page", WRITTEN_PAGES, ids=name_page)
def test_python_in_a_page_compiles(page: Path) -> None:
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        compile(block, name_page(page), "exec")


def test_long_sentences_dead_links_and_old_words_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"# A page\n\nShort. W{'word ' * 41}end.\n\n[one](none.md) [two](#a-page) [three](#b)\n")
    lengths = [count_words(one) for one in split_sentences(page.read_text())]
    assert max(lengths) == 42
    assert find_dead_links(page) == ["none.md", "#b"]
    assert split_sentences("A list:\n\n* `a.b c` is one. And two!\n\n    code = 1\n\n| a. b |\n") == [
        "A list:",
        "a_b_c is one.",
        "And two!",
    ]
