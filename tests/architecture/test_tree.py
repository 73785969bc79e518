"""The content of the project's folder, and what its files may not say."""

import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOP = {"harness", "solvers", "configs", "tests", "results"}
TOP |= {"pyproject.toml", "README.md", "README.md.j2", "LICENSE", "CITATION.cff"}


@pytest.fixture(scope="module")
def files() -> list[Path]:
    """The files that git tracks or would track, relative to the root."""
    if not (ROOT / ".git").exists():
        pytest.skip("which files are the project's is only known in a git checkout")
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [Path(name) for name in sorted(set(printed.split("\0")) - {""}) if (ROOT / name).is_file()]


def lines_that_match(pattern: str, files: list[Path]) -> list[str]:
    """`file:line: text` for all lines of the text files in which the pattern occurs."""
    found = []
    for file in files:
        content = (ROOT / file).read_bytes()
        if b"\0" in content:
            continue
        lines = enumerate(content.decode().splitlines(), start=1)
        found += [f"{file}:{number}: {line}" for number, line in lines if re.search(pattern, line)]
    return found


def test_the_top_level_is_fixed(files: list[Path]):
    assert {file.parts[0] for file in files if not file.parts[0].startswith(".")} == TOP


# Written so that no pattern matches its own text.
@pytest.mark.parametrize(
    "pattern",
    [
        pytest.param(r"(?<![\w.)}\]])/(home|root|tmp|Users|work|workspace|mnt|opt)/\w", id="path of one machine"),
        pytest.param(r"https?://[^\s\"']*/(simple|packages|pool|-)/", id="download address of a registry"),
        pytest.param(r"pypi\.org|pythonhosted\.org|registry\.npmjs|deb\.debian|crates\.io", id="registry"),
        pytest.param(r"\b([T]ODO|[F]IXME|[X]XX)\b", id="unfinished"),
    ],
)
def test_no_file_speaks_of(pattern: str, files: list[Path]):
    assert lines_that_match(pattern, files) == []
