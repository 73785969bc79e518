"""One run: a failure leaves a row and nothing that would hide it."""

from pathlib import Path

import pytest

from harness.base import machine
from harness.config.load import load_any
from harness.experiments import run
from harness.experiments.run import Files, execute


def test_a_run_that_fails_now_keeps_nothing_of_when_it_did_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "scene.yaml").write_text(
        "mesh: {kind: chain}\nmass: 1\ntime_step: 0.1\nframes: 2\ndefault_size: 3\neffects: [{kind: gravity}]\n"
    )
    (spec,) = load_any(tmp_path / "scene.yaml", solvers=["sparse"]).runs()
    files = Files.of(spec, tmp_path)
    files.rows.parent.mkdir()
    assert {row["status"] for row in execute(spec, files, lambda phase: None)} == {"ok"}
    files.picture.parent.mkdir()
    files.picture.touch()
    assert files.recording.exists()
    assert files.recording.name == f"{spec.label(machine.describe().id)}.rrd"

    def broken(*_):
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr(run, "measure", broken)
    (row,) = execute(spec, files, lambda phase: None)
    assert row["status"] == "failed"
    assert "ZeroDivisionError: nothing to divide by (test_run.py:" in row["reason"]
    assert not files.recording.exists()
    assert not files.picture.exists()
    assert files.rows.exists()
