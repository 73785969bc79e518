"""The table of planted lies fits the sources as they are; `python -m tests.mutations` plants them."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from tests.mutations.base import ROOT, Mutation, Stale
from tests.mutations.planted import TABLE
from tests.mutations.runner import PYTEST, Copy, examine


def test_there_are_sixty_of_them_and_each_has_a_name_of_its_own():
    assert len(TABLE) >= 60
    assert len({lie.name for lie in TABLE}) == len(TABLE)
    assert len({(lie.file, lie.fragment, lie.replacement, lie.tests) for lie in TABLE}) == len(TABLE)


@pytest.mark.parametrize("lie", TABLE, ids=lambda lie: lie.name)
def test_each_can_be_planted_and_names_tests_that_exist(lie: Mutation):
    changed = lie.applied(ROOT)
    if lie.file.endswith(".py"):
        ast.parse(changed)
    assert changed != (ROOT / lie.file).read_text()
    for test in lie.tests:
        path, _, name = test.partition("::")
        assert f"def {name or 'test_'}" in (ROOT / path).read_text()


def test_the_command_that_runs_them_is_one_that_pytest_knows():
    command = [sys.executable, *PYTEST, "--collect-only", "tests/unit/test_round_off.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_what_stands_elsewhere_or_twice_is_refused(tmp_path: Path):
    lie = replace(TABLE[0], file="here.py", fragment="x = 1")
    with pytest.raises(Stale, match=r"there is no here\.py"):
        lie.applied(tmp_path)
    for text, times in (("y = 1\n", 0), ("x = 1\nx = 1\n", 2)):
        (tmp_path / "here.py").write_text(text)
        with pytest.raises(Stale, match=f"stands {times} times in here.py"):
            lie.applied(tmp_path)


class ByChance(Copy):
    """Tests that are known beforehand: the first failure is chance's, the second the lie's."""

    def __init__(self) -> None:
        self.planted_now, self.whole = False, 0

    @contextmanager
    def planted(self, lie: Mutation) -> Iterator[None]:
        self.planted_now = True
        yield
        self.planted_now = False

    def run_command(self, lie: Mutation, command: list[str], limit: float) -> tuple[int, str]:
        if "tests/unit" in command:
            self.whole += 1
            failed = "test_found" if "--deselect=test_chance[a b]" in command else "test_chance[a b]"
            return 1, f"FAILED {failed} - why"
        return int(self.planted_now and "test_found" in command), "1 passed"


def test_a_test_of_the_whole_suite_that_failed_by_chance_finds_nothing_out():
    copy = ByChance()
    found = examine(copy, TABLE[0], whole=True)
    assert (found.tests, found.failed, copy.whole) == ("caught", "test_found", 2)
