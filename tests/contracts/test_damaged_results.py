"""Results that were damaged: rows and recordings that are cut, empty, foreign or flipped, and what is in their way."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from springbench.harness.cli.main import app
from springbench.harness.errors import InputError
from springbench.harness.recording.recording_reader import read_replay, summarise_recording
from springbench.harness.results import parquet_rows
from typer.testing import CliRunner

from tests.contracts.attempts import attempt
from tests.contracts.hostile import scene
from tests.synthetic_recordings import write_recording

SWEEP = "{scenes: [good.yaml], sizes: [4], solvers: [sparse, dense], options: {rounds: 1, pictures: false}}"


@pytest.fixture(scope="module")
def finished_files(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, bytes]:
    """The files of a sweep that has been run, by their places."""
    home = tmp_path_factory.mktemp("finished")
    (home / "good.yaml").write_text(scene())
    (home / "sweep.yaml").write_text(SWEEP)
    result = CliRunner().invoke(
        app, ["run", "--in-process", str(home / "sweep.yaml"), "--results", str(home / "results")]
    )
    assert result.exit_code == 0, result.output
    return {path.relative_to(home): path.read_bytes() for path in home.rglob("*") if path.is_file()}


@pytest.fixture
def home(finished_files: dict[Path, bytes], tmp_path: Path) -> Path:
    """A copy of them."""
    for place, content in finished_files.items():
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_bytes(content)
    return tmp_path


def foreign(path: Path) -> None:
    pq.write_table(pa.table({"colour": ["red"], "status": [None], "seconds": ["[red]soon[/red]"]}), path)


def many(path: Path) -> None:
    pq.write_table(pa.table({"status": pa.array(["ok"] * (parquet_rows.MAX_ROWS + 1)).dictionary_encode()}), path)


def replace_file(path: Path, make: Callable[[Path], object]) -> None:
    path.unlink()
    make(path)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: os.truncate(path, path.stat().st_size // 2),
    "less its last byte": lambda path: os.truncate(path, path.stat().st_size - 1),
    "without rows": lambda path: parquet_rows.write_rows(path, []),
    "foreign": foreign,
    "of many rows": many,
    "text": lambda path: path.write_text("status\nok\n"),
    "noise": lambda path: path.write_bytes(bytes(range(256)) * 16),
    "a head alone": lambda path: path.write_bytes(b"PAR1PAR1"),
    "a device": lambda path: replace_file(path, lambda there: there.symlink_to("/dev/zero")),
    "a pipe": lambda path: replace_file(path, os.mkfifo),
    "a folder": lambda path: replace_file(path, Path.mkdir),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_rows_are_named_and_refused(home: Path, damage: str):
    path = sorted(home.glob("results/sweep/rows/*.parquet"))[0]
    DAMAGES[damage](path)
    listed = attempt(home, ["list", "sweep.yaml"])
    assert (listed.code, listed.error) == (0, "")
    assert "missing (damaged)" in listed.said
    reported = attempt(home, ["report", "results/sweep"])
    assert (reported.code, reported.error) == (2, "")
    assert path.name in reported.said
    requested = attempt(home, ["query", "SELECT * FROM rows"])
    assert (requested.code, requested.error) in ((0, ""), (2, ""))


def test_the_runs_of_damaged_rows_and_recordings_are_done_again(home: Path):
    first, second = sorted(home.glob("results/sweep/rows/*.parquet"))
    recording = home / "results/sweep/recordings" / f"{second.stem}.rrd"
    os.truncate(first, 100)
    os.truncate(recording, recording.stat().st_size - 100)
    result = CliRunner().invoke(
        app, ["run", "--in-process", str(home / "sweep.yaml"), "--results", str(home / "results")]
    )
    assert result.exit_code == 0, result.output
    said = " ".join(result.output.split())
    assert f"{first.name} contains no rows" in said
    assert f"{recording.name} is cut before its end" in said
    assert parquet_rows.read_rows([first, second], required_columns=("status",)).num_rows > 0
    assert len(read_replay(recording).frames) == 3
    again = CliRunner().invoke(
        app, ["run", "--in-process", str(home / "sweep.yaml"), "--results", str(home / "results")]
    )
    assert "2 of 2 runs are there already" in again.output


LOCKS: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "folder": Path.mkdir,
    "link to elsewhere": lambda path: path.symlink_to(path.parents[2] / "victim"),
    "device": lambda path: path.symlink_to("/dev/zero"),
}


@pytest.mark.parametrize("lock", LOCKS)
def test_a_file_in_place_of_the_lock_is_a_mistake(home: Path, lock: str):
    (home / "victim").write_text("precious")
    path = home / "results" / "sweep" / ".lock"
    replace_file(path, LOCKS[lock])
    result = attempt(home, ["run", "sweep.yaml"])
    assert (result.code, result.error, result.outside) == (2, "", [])
    assert ".lock" in result.said
    assert (home / "victim").read_text() == "precious"


def test_two_configs_of_one_name_do_not_share_their_results(home: Path):
    (home / "other").mkdir()
    (home / "other" / "sweep.yaml").write_text((home / "sweep.yaml").read_text())
    (home / "other" / "good.yaml").write_text(scene(frames="3"))
    result = attempt(home, ["run", "--in-process", "other/sweep.yaml"])
    assert result.code == 2
    assert "contains the results of another file of this name" in result.said
    (home / "sweep.yaml").unlink()  # it was moved
    assert attempt(home, ["run", "--in-process", "other/sweep.yaml"]).code == 0


def test_query_output_is_text_and_not_markup(home: Path):
    parquet_rows.write_rows(
        home / "results/sweep/rows/x.parquet", [{"scene": "[red]x[/nothing]", "status": "ok", "run_id": "\x1b[2J"}]
    )
    result = attempt(home, ["query", 'SELECT scene, run_id AS "[bold" FROM rows WHERE solver IS NULL'])
    assert (result.code, result.error) == (0, "")
    assert "[red]x[/nothing]" in result.said
    assert "\x1b[2J" not in result.said


def flips(count: int, seed: int, tmp_path: Path) -> tuple[int, int]:
    """So many recordings with a flipped bit each: how many were read and how many refused; anything else fails."""
    content, random = write_recording(tmp_path / "a.rrd").read_bytes(), np.random.default_rng(seed)
    read = refused = 0
    for k in range(count):
        bit = int(random.integers(8 * len(content)))
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        (tmp_path / f"{k}.rrd").write_bytes(flipped)
        for look in (summarise_recording, read_replay):
            try:
                look(tmp_path / f"{k}.rrd")
                read += 1
            except InputError as error:
                refused += f"{k}.rrd" in str(error)
        (tmp_path / f"{k}.rrd").unlink()
    return read, refused


def test_a_recording_with_a_flipped_bit_is_read_or_refused(tmp_path: Path):
    read, refused = flips(25, 1, tmp_path)
    assert read + refused == 50
    assert refused > 0


@pytest.mark.long
def test_recordings_with_flipped_bits_are_read_or_refused(tmp_path: Path):
    assert sum(flips(400, 2, tmp_path)) == 800
