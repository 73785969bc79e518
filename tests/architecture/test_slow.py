"""The list of slow tests names what is there."""

from __future__ import annotations

from tests import slow_tests


def test_each_line_names_a_file_or_a_test_in_it() -> None:
    for line in slow_tests.read_slow_names():
        path, _, name = line.partition("::")
        source = (slow_tests.TESTS_FOLDER.parent / path).read_text()
        assert not name or f"def {name.partition('[')[0]}(" in source, (
            f"{line}: mend tests/slow.txt, see tests/slow_tests.py"
        )
