"""A terminal shows what a command does before anything slow is imported."""

from __future__ import annotations

import io
import os
import subprocess
import sys

import pytest
from springbench.harness import console

START_OF_A_COMMAND = """
import sys, types
stub = types.ModuleType("springbench.harness.cli.main")
stub.main = lambda: print(*sys.modules)
sys.modules["springbench.harness.cli.main"] = stub
sys.argv = ["springbench", "validate"]
from springbench.harness.__main__ import main
main()
"""
SLOW_MODULES = {
    "duckdb",
    "matplotlib",
    "numba",
    "numpy",
    "pyarrow",
    "pydantic",
    "rich",
    "ruamel.yaml",
    "scipy",
    "typer",
}


@pytest.mark.skipif(sys.platform == "win32", reason="has no pseudo-terminals")
def test_a_command_announces_itself_before_it_imports_anything_slow():
    screen, terminal = os.openpty()
    ended = subprocess.run(
        [sys.executable, "-c", START_OF_A_COMMAND], stdout=subprocess.PIPE, stderr=terminal, text=True, check=True
    )
    assert os.read(screen, 100).startswith(b"loading ...")
    assert not SLOW_MODULES & set(ended.stdout.split())
    os.close(terminal)
    os.close(screen)


def test_an_activity_replaces_the_last_one_and_is_in_no_file(monkeypatch: pytest.MonkeyPatch):
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for stream in (Terminal(), io.StringIO()):
        monkeypatch.setattr(sys, "stderr", stream)
        console.show_activity("reading the rows")
        console.show_activity("drawing")
        lines = stream.getvalue().split("\r")
        if stream.isatty():
            assert len(lines[1]) >= len(lines[0].rstrip())
            assert [line.rstrip() for line in lines] == ["reading the rows ...", "drawing ...", ""]
        else:
            assert lines == [""]
