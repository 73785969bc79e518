"""Two commands may share a folder of results: each run is done once, and what one leaves undone the other does."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from time import sleep

import pytest
from springbench.harness.errors import InputError
from springbench.harness.execution import folder_locks
from springbench.harness.execution.folder_locks import CLAIMED_ELSEWHERE, DONE_ELSEWHERE, UnitClaims
from springbench.harness.results import parquet_rows

from tests.plugin_solvers import SCENE_SOURCE

ROOT = Path(__file__).resolve().parents[2]
RUNS = 4
SWEEP = f"scenes: [scene.yaml]\nsizes: {list(range(3, 3 + RUNS))}\nsolvers: [sparse]\n" + (
    "options: {frames: 40, rounds: 1, max_iterations: 20, record: false, pictures: false}\n"
)


def sweep(folder: Path) -> Path:
    (folder / "scene.yaml").write_text(SCENE_SOURCE)
    (folder / "sweep.yaml").write_text(SWEEP)
    return folder / "sweep.yaml"


def start_command(config: Path, workers: int = 1) -> subprocess.Popen[str]:
    command = ["run", str(config), "--results", str(config.parent / "r"), "--workers", str(workers)]
    return subprocess.Popen([sys.executable, "-m", "springbench", *command], cwd=ROOT, stdout=-1, stderr=-2, text=True)


def count_done_runs(said: str) -> Counter[str]:
    """How often each run was done, by what a command printed."""
    return Counter(re.findall(r"scene (\d+) sparse: [\d.]+ ms a step", " ".join(said.split())))


def test_each_run_is_done_by_one_of_two_commands(tmp_path: Path):
    config = sweep(tmp_path)
    both = [start_command(config), start_command(config)]
    said = [command.communicate()[0] for command in both]
    assert [command.returncode for command in both] == [0, 0], said
    counts = [count_done_runs(one) for one in said]
    assert sum(counts, Counter()) == Counter(map(str, range(3, 3 + RUNS))), said
    assert len(list((tmp_path / "r" / "sweep" / "rows").glob("*.parquet"))) == RUNS


@pytest.mark.long
def test_what_a_killed_command_had_claimed_is_done_by_the_other(tmp_path: Path):
    config, saved = sweep(tmp_path), tmp_path / "r" / "sweep" / "rows"
    first = start_command(config)
    while not list(saved.glob("*.parquet")) and first.poll() is None:
        sleep(0.01)
    second = start_command(config)
    sleep(0.5)
    first.kill()
    first.communicate()
    said, _ = second.communicate()
    assert second.returncode == 0, said
    assert len(list(saved.glob("*.parquet"))) == RUNS
    assert not list((tmp_path / "r").rglob(".*partial*"))


CLAIM = "from pathlib import Path; from springbench.harness.execution.folder_locks import UnitClaims; import sys\n"


def claimed_elsewhere(folder: Path, unit: Path) -> subprocess.Popen[str]:
    code = f"{CLAIM}c = UnitClaims(Path(sys.argv[1]), [u := Path(sys.argv[2])]); print(c.try_claim(u), flush=True)"
    code += "; input()"
    other = subprocess.Popen([sys.executable, "-c", code, str(folder), str(unit)], stdin=-1, stdout=-1, text=True)
    assert other.stdout
    assert other.stdout.readline() == "\n"
    return other


def test_a_claim_excludes_others_and_ends_with_its_process(tmp_path: Path):
    unit, free = tmp_path / "a.parquet", tmp_path / "b.parquet"
    claims = UnitClaims(tmp_path, [unit, free])
    other = claimed_elsewhere(tmp_path, unit)
    assert claims.try_claim(unit) == CLAIMED_ELSEWHERE
    assert claims.try_claim(free) == ""
    other.kill()
    other.wait()
    claims.wait_for_any([unit])
    assert claims.try_claim(unit) == ""
    claims.close()


def test_a_unit_that_its_claimant_completed_is_done_though_the_claim_remains(tmp_path: Path):
    unit = tmp_path / "a.parquet"
    claims, other = UnitClaims(tmp_path, [unit]), claimed_elsewhere(tmp_path, unit)
    parquet_rows.write_rows(unit, [{"run_id": "x"}])
    claims.wait_for_any([unit])
    assert claims.try_claim(unit) == DONE_ELSEWHERE
    other.kill()
    other.wait()
    claims.close()


def test_a_unit_that_another_process_completed_since_is_not_repeated(tmp_path: Path):
    unit = tmp_path / "a.parquet"
    claims = UnitClaims(tmp_path, [unit])
    parquet_rows.write_rows(unit, [{"run_id": "x"}])
    assert claims.try_claim(unit) == DONE_ELSEWHERE
    claims.wait_for_any([unit])
    claims.close()


def test_a_process_that_packs_a_folder_has_exclusive_access(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(folder_locks, "_LOCK_TIMEOUT", 0.0)
    with (
        folder_locks.lock_folder_shared(tmp_path),
        pytest.raises(InputError, match="another springbench is running"),
        folder_locks.lock_folder_exclusive(tmp_path),
    ):
        pass
    with (
        folder_locks.lock_folder_exclusive(tmp_path),
        pytest.raises(InputError, match="has locked it exclusively"),
        folder_locks.lock_folder_shared(tmp_path),
    ):
        pass


def test_the_first_and_the_last_remove_what_is_half_written(tmp_path: Path):
    half = tmp_path / "rows" / ".a.1.partial.parquet"
    half.parent.mkdir()
    half.touch()
    with folder_locks.lock_folder_shared(tmp_path):
        assert not half.exists()
        half.touch()
        with folder_locks.lock_folder_shared(tmp_path):
            assert half.exists()
        assert half.exists()
    assert not half.exists()
