"""Publishing results and verifying them: what was changed is found, and what is in an archive comes out again."""

import json
import subprocess
import zipfile
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner, Result

from harness.base import rows
from harness.base.console import err
from harness.base.progress import Lines
from harness.cli import app
from harness.experiments.archive import verify
from harness.experiments.archive.verify import Claim, Holds, Published
from tests.contracts.hostile import scene
from tests.dummies import dummy_rows

SWEEP = """
scenes: [cloth.yaml]
sizes: [4]
solvers: [sparse, dense]
options: {rounds: 1, record: false, pictures: false, iterations: 3}
"""


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep that has been run, published as `x.zip`, and packed afterwards as `packed.zip`."""
    home = tmp_path_factory.mktemp("published")
    (home / "cloth.yaml").write_text(scene())
    (home / "sweep.yaml").write_text(SWEEP)
    for arguments in (
        ("run", home / "sweep.yaml", "--results", home / "results"),
        ("publish", home / "results", "-o", home / "x.zip", "--license", "CC-BY-4.0"),
        ("compact", home / "results"),
        ("publish", home / "results" / "sweep", "-o", home / "packed.zip"),
    ):
        told = command(*arguments)
        assert told.exit_code == 0, told.output
    return home


def changed(archive: Path, into: Path, change: Callable[[dict[str, bytes]], None], *, sums: bool) -> Path:
    """An archive with another content; sums: with the checksums of that."""
    with zipfile.ZipFile(archive) as packed:
        content = {name: packed.read(name) for name in packed.namelist()}
    change(content)
    if sums:
        names = sorted(content.keys() - {"SHA256SUMS"})
        content["SHA256SUMS"] = "".join(f"{sha256(content[n]).hexdigest()}  {n}\n" for n in names).encode()
    with zipfile.ZipFile(into, "w") as packed:
        for name, data in content.items():
            packed.writestr(name, data)
    return into


@pytest.mark.parametrize("name", ["x.zip", "packed.zip"])
def test_what_was_published_comes_out_again(home: Path, name: str, tmp_path: Path):
    with verify.unpacked(home / name) as folder:
        subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=folder, check=True)
        assert verify.checksums(folder) == []
        runs = verify.published(folder, print, own_code=False)
        assert [one.title for one in runs] == ["cloth 4 dense", "cloth 4 sparse"]
        claims = verify.again(verify.chosen(runs, seed=1), tmp_path, Lines(err()))
        listed = command("list", folder / "configs" / "sweep" / "sweep.yaml", "--results", folder / "results")
        assert listed.output.count("done") == 2
    assert sorted(map(str, claims[:2])) == [
        f"cloth 4 {solver}, positions: holds (2 steps, to the bit)" for solver in ("dense", "sparse")
    ]
    assert "times as long as" in claims[2].what


def test_the_metadata_name_each_file_with_its_sum_and_what_may_be_done_with_it(home: Path):
    with zipfile.ZipFile(home / "x.zip") as packed:
        crate = {entity["@id"]: entity for entity in json.loads(packed.read("ro-crate-metadata.json"))["@graph"]}
        names = set(packed.namelist()) - {"ro-crate-metadata.json", "SHA256SUMS"}
        assert {part["@id"] for part in crate["./"]["hasPart"]} == names
        assert all(sha256(packed.read(name)).hexdigest() == crate[name]["sha256"] for name in names)
    assert crate["./"]["license"] == "CC-BY-4.0"
    assert {"CITATION.cff", "environment/requirements.txt", "configs/sweep/cloth.yaml"} <= names


def test_an_archive_that_was_changed_is_named_and_none_of_it_is_run(home: Path, tmp_path: Path):
    def change(content: dict[str, bytes]) -> None:
        content["configs/sweep/sweep.yaml"] += b" "
        content["mine.py"] = b"raise SystemExit"
        del content["CITATION.cff"]

    told = command("verify", changed(home / "x.zip", tmp_path / "y.zip", change, sums=False))
    assert told.exit_code == 1
    for line in ("sweep.yaml: does not hold (was changed)", "mine.py: does not hold (was not", "(missing)"):
        assert line in told.output
    assert "done again" not in told.output


def test_rows_that_lie_under_true_checksums_do_not_hold(home: Path, tmp_path: Path):
    def change(content: dict[str, bytes]) -> None:
        for name in [name for name in content if name.endswith(".parquet")]:
            (tmp_path / "x.parquet").write_bytes(content[name])
            lies = pq.read_table(tmp_path / "x.parquet").to_pylist()
            rows.write(tmp_path / "x.parquet", [row | {"digest": row["digest"] and "0" * 64} for row in lies])
            content[name] = (tmp_path / "x.parquet").read_bytes()

    told = command("verify", changed(home / "x.zip", tmp_path / "y.zip", change, sums=True))
    assert told.exit_code == 1, told.output
    assert "positions: does not hold (they differ from step 1 of 2 on)" in told.output


def test_an_archive_whose_results_lead_to_another_config_is_refused(home: Path, tmp_path: Path):
    def change(content: dict[str, bytes]) -> None:
        content["results/sweep/.config"] = str(home / "sweep.yaml").encode()

    told = command("verify", changed(home / "x.zip", tmp_path / "y.zip", change, sums=True))
    assert (told.exit_code, "leads out of the archive" in told.output) == (2, True)


BAD: dict[str, Callable[[Path], object]] = {
    "not there": lambda path: None,
    "text": lambda path: path.write_text("results"),
    "another archive": lambda path: zipfile.ZipFile(path, "w").close(),
}


@pytest.mark.parametrize("kind", BAD)
def test_what_is_no_such_archive_is_the_users_mistake(tmp_path: Path, kind: str):
    BAD[kind](tmp_path / "x.zip")
    told = command("verify", tmp_path / "x.zip")
    assert (told.exit_code, "springbench: " in told.output) == (2, True)


def test_damaged_rows_are_not_published(home: Path, tmp_path: Path):
    (tmp_path / "sweep" / "rows").mkdir(parents=True)
    (tmp_path / "sweep" / "rows" / "a.parquet").write_bytes(b"PAR1")
    told = command("publish", tmp_path, "-o", tmp_path / "x.zip")
    assert (told.exit_code, "a.parquet" in told.output) == (2, True)
    assert not (tmp_path / "x.zip").exists()
    assert command("publish", home / "results", "-o", tmp_path / "x.tar").exit_code == 2


def claim(home: Path, factor: float, *, interrupted: bool = False, machine: str = "00000000") -> Claim:
    """What is said of a ratio that was 1 and is `factor`."""
    with verify.unpacked(home / "x.zip") as folder:
        run = verify.published(folder, print, own_code=False)[0].run
    old = [row | {"interrupted": False} for row in dummy_rows(1)]
    there = (Published(old, run), Published(old, run.but(size=5)))
    slower = [row | {"seconds": row["seconds"] * factor, "interrupted": interrupted} for row in old]
    here = [[row | {"machine": machine} for row in found] for found in (slower, old)]
    return verify._ratio(there, (here[0], here[1]))


def test_a_ratio_holds_or_not_or_cannot_be_told(home: Path):
    assert claim(home, 1.2).holds is claim(home, 1 / 1.2).holds is Holds.YES
    assert claim(home, 1.4).holds is claim(home, 1 / 1.4).holds is Holds.NO
    assert claim(home, 1.4, interrupted=True).holds is Holds.UNKNOWN
    assert claim(home, 1.4, machine="another").holds is Holds.YES
    assert claim(home, 2.4, machine="another").holds is Holds.UNKNOWN


def test_a_tenth_is_chosen_and_each_has_another_solver_beside_it(home: Path):
    with verify.unpacked(home / "x.zip") as folder:
        (a, b) = verify.published(folder, print, own_code=False)
    runs = [replace(one, run=one.run.but(size=size)) for size in range(10) for one in (a, b)]
    for seed in range(20):
        taken = verify.chosen(runs, seed)
        assert len(taken) in (2, 4)
        assert all(sum(other.group == one.group for other in taken) == 2 for one in taken)
    assert len({one.title for seed in range(20) for one in verify.chosen(runs, seed)}) > 8
    assert verify.chosen([], 0) == []
