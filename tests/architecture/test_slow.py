"""The list of slow tests names what is there."""

from __future__ import annotations

from tests import slow


def test_each_line_names_a_file_or_a_test_in_it() -> None:
    for line in slow.read_slow_names():
        path, _, name = line.partition("::")
        source = (slow.TESTS_FOLDER.parent / path).read_text()
        assert not name or f"def {name.partition('[')[0]}(" in source, f"{line}: mend tests/slow.txt, see tests/slow.py"
