"""Scenes that lack what others have still run, record and draw: no springs, no pins, nothing at all."""

from pathlib import Path

import pytest
from springbench.harness.cli.main import app
from springbench.harness.recording.recording_reader import read_replay
from typer.testing import CliRunner

from tests.rare_cases import mark_rare_cases

SCENES = {
    "falls": "[{kind: gravity}]",
    "springs-without-stiffness": "[{kind: springs, stretch: 0}, {kind: gravity}]",
    "pins-alone": "[{kind: pins, parts: [corners]}]",
    "all-pinned-exactly": (
        "[{kind: springs, stretch: 10}, {kind: pins, parts: [boundary], indices: [4], weight: exact}]"
    ),
    "nothing": "[]",
}


@pytest.mark.parametrize("name", mark_rare_cases(SCENES, ["nothing", "falls"]))
def test_a_bare_scene_runs_and_is_recorded(name: str, tmp_path: Path):
    scene = tmp_path / f"{name}.yaml"
    scene.write_text(
        f"mesh: {{kind: grid}}\nmass: 1\ntime_step: 1/30\nframes: 3\ndefault_size: 3\neffects: {SCENES[name]}\n"
    )
    outcome = CliRunner().invoke(app, ["run", str(scene), "--solver", "sparse", "--results", str(tmp_path / "out")])
    assert outcome.exit_code == 0, outcome.output
    (recording,) = (tmp_path / "out" / name / "recordings").glob("*.rrd")
    replay = read_replay(recording)
    assert replay.positions.shape == (4, 9, 3)
    assert len(replay.springs) == len(replay.rest_lengths)
    assert CliRunner().invoke(app, ["inspect", str(recording)]).exit_code == 0
