"""From the last line of a sweep to its answers, in a real browser: three clicks, counted."""

from __future__ import annotations

import hashlib
import shlex
from pathlib import Path
from statistics import median

import pytest
from springbench.harness.cli.main import app
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.results import parquet_rows as base_rows
from typer.testing import CliRunner

from tests.headless_browser import launch_chromium

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
SWEEP = """
scenes: [scenes/hanging-cloth.yaml]
sizes: [4, 8]
solvers: [dense, sparse]
options: {frames: 3, rounds: 2, max_iterations: 20}
"""
"""Both solvers take the same iterates, so that all are equally accurate; only the rows show which is faster."""


def run_command(*words: str) -> str:
    result = CliRunner().invoke(app, [*words, "--in-process"])
    assert result.exit_code == 0, result.output
    return result.output


def ends(folder: Path) -> dict[str, dict[str, str]]:
    """The last row of each solver's runs of the largest size, by the medians of their times."""
    table = [row for path in folder.glob("*.parquet") for row in base_rows.read_rows([path]).to_pylist()]
    steps = [row for row in table if row["phase"] == "step" and row["size"] == 8]
    solvers = {row["solver"] for row in steps}
    taken = {s: median(row["seconds"] for row in steps if row["solver"] == s) for s in solvers}
    last = {row["solver"]: row for row in sorted(steps, key=lambda row: row["frame"])}
    return {s: last[s] for s in sorted(taken, key=taken.__getitem__)}


@pytest.mark.slow
def test_three_clicks_lead_to_the_fastest_solver_its_last_frame_and_the_command_that_repeats_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scenes").symlink_to(SCENES)
    (tmp_path / "study.yaml").write_text(SWEEP)
    last_line = run_command("run", "study.yaml").splitlines()[-1]
    fastest, row = next(iter(ends(tmp_path / "results" / "study" / "rows").items()))
    with launch_chromium() as browser:
        page, clicks = browser.new_page(viewport={"width": 1280, "height": 800}), 0

        page.goto(last_line.rpartition(" ")[2])
        clicks += 1
        finding = page.get_by_role("listitem").filter(has_text="fastest at equal accuracy")
        assert f"is {fastest}," in finding.inner_text(), "as the rows have it"
        assert finding.is_visible()

        finding.get_by_role("link", name="the run").click()
        clicks += 1
        panel = page.get_by_role("complementary")
        command = panel.get_by_label("Command that repeats the run").inner_text()
        assert f"--solver {fastest}" in command

        with page.expect_download() as taken:
            panel.get_by_role("link", name="The recording (.rrd)").click()
        clicks += 1
        assert clicks == 3
        taken.value.save_as(tmp_path / "taken.rrd")
    replay = read_replay(tmp_path / "taken.rrd")
    assert len(replay.positions) == 4, "three steps, and the start"
    assert hashlib.sha256(replay.positions[-1].tobytes()).hexdigest() == row["recording_digest"]

    program, *words = shlex.split(command)
    assert program == "springbench"
    run_command(*words)
    (again,) = ends(tmp_path / "results" / "hanging-cloth" / "rows").values()
    assert (again["solver"], again["positions_digest"]) == (fastest, row["positions_digest"])
