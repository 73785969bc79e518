"""The lists of slow and long tests name existing tests."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests import slow_tests

LISTS = slow_tests.SLOW_LIST, slow_tests.LONG_LIST, slow_tests.COMPILING_LIST


@pytest.mark.parametrize("names", LISTS, ids=lambda path: path.stem)
def test_each_line_names_a_file_or_a_test_in_it(names: Path) -> None:
    for line in slow_tests.read_names(names):
        path, _, name = line.partition("::")
        source = (slow_tests.TESTS_FOLDER.parent / path).read_text()
        assert not name or f"def {name.partition('[')[0]}(" in source, f"{line}: mend {names}, see tests/slow_tests.py"
