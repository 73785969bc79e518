"""What was read from sources is stored for exactly the state that it was read in."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from springbench.solvers.jit import source_digest
from springbench.solvers.jit.source_digest import SourceFacts, read_facts, store_facts


def test_facts_are_read_back_for_the_state_of_the_sources_that_they_were_read_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    paths = [str(tmp_path / name) for name in ("one.py", "two.py")]
    for path in paths:
        Path(path).write_text("import two\n")
    states = {path: os.stat(path) for path in paths}
    facts = {paths[0]: SourceFacts("00", [paths[1]]), paths[1]: SourceFacts("ff", [])}
    store_facts(states, facts)
    assert read_facts(states) == {}  # two edits within one tick of the file system's clock look alike
    monkeypatch.setattr(source_digest, "_SETTLING_NS", -(10**11))
    store_facts(states, facts)
    assert read_facts(states) == facts
    (stored,) = (tmp_path / "cache").rglob("*.json")

    Path(paths[0]).write_text("import one\n")  # as long as before, and dated back
    os.utime(paths[0], ns=(states[paths[0]].st_atime_ns, states[paths[0]].st_mtime_ns))
    changed = {path: os.stat(path) for path in paths}
    assert read_facts(changed) == {}
    store_facts(states, facts)  # read before the edit: nothing new is stored
    assert read_facts(changed) == {}

    stored.write_text(stored.read_text()[:-9])
    assert read_facts(states) == {}
