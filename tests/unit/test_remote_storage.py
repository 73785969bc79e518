"""Results on another file system: what is there is read, what is new is sent, and what was killed is made up for."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from springbench.harness.cli.main import app
from springbench.harness.results.remote_storage import RemoteStorage
from typer.testing import CliRunner, Result

from tests.contracts.hostile import scene
from tests.synthetic_run_rows import write_dummy_runs

SWEEP = "{scenes: [cloth.yaml], sizes: [4], solvers: [sparse], options: {rounds: 1, record: false, pictures: false}}"


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


def list_files(place: Path) -> list[Path]:
    """The files of rows in a place; the page's tables are not among them."""
    return [path for path in place.rglob("*.parquet") if "site" not in path.parts]


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    (tmp_path / "cloth.yaml").write_text(scene())
    (tmp_path / "sweep.yaml").write_text(SWEEP)
    return tmp_path / "sweep.yaml"


def test_files_are_copied_in_both_directions_and_existing_ones_are_not(tmp_path: Path):
    there = tmp_path / "there"
    units = write_dummy_runs(there / "sweep", 3)
    (there / "sweep" / "recordings").mkdir()
    (there / "sweep" / "recordings" / "a.rrd").write_text("a recording")
    place = RemoteStorage.from_url(f"file://{there}")
    place.download_changes(only_rows=True)
    assert len([path for path in place.folder.rglob("*.*") if path.suffix in (".parquet", ".rrd")]) == 3
    (here,) = place.folder.rglob(units[0].name)
    fetched = here.stat().st_ino
    (place.folder / "sweep" / "rows.parquet").write_text("packed")
    (place.folder / "sweep" / "rows" / units[1].name).unlink()
    os.unlink(units[2])
    again = RemoteStorage.from_url(f"file://{there}/")
    again.download_changes()
    assert here.stat().st_ino == fetched
    assert (again.folder / "sweep" / "recordings" / "a.rrd").read_text() == "a recording"
    again.upload_changes()
    left = {path.relative_to(there).as_posix() for path in there.rglob("*") if path.is_file()}
    assert left == {f"sweep/rows/{units[0].name}", "sweep/rows.parquet", "sweep/recordings/a.rrd"}


def test_what_was_changed_on_both_sides_is_taken_from_here(tmp_path: Path):
    (tmp_path / "there").mkdir()
    file = tmp_path / "there" / "a.txt"
    file.write_text("old")
    place = RemoteStorage.from_url(f"file://{tmp_path / 'there'}")
    place.download_changes()
    (place.folder / "a.txt").write_text("changed here")
    file.write_text("changed there as well")
    again = RemoteStorage.from_url(f"file://{tmp_path / 'there'}")
    again.download_changes()
    again.upload_changes()
    assert file.read_text() == "changed here"


def a_sweep_lives_at(url: str, config: Path, cache: Path) -> None:
    """Run, list, query, pack and query again, as from three machines."""
    for machine in range(3):
        os.environ["XDG_CACHE_HOME"] = str(cache / str(machine))
        result = command("run", config, "--results", url)
        assert result.exit_code == 0, result.output
        assert ("1 of 1 runs are there already" in result.output) == (machine > 0)
    requested = command("query", "SELECT DISTINCT scene, solver FROM rows", "--results", url, "--csv")
    assert requested.output.split() == ["scene,solver", "cloth,sparse"]
    packed = command("compact", url)
    assert packed.exit_code == 0, packed.output
    os.environ["XDG_CACHE_HOME"] = str(cache / "4")
    assert (
        command("query", "SELECT DISTINCT scene, solver FROM rows", "--results", url, "--csv").output
        == requested.output
    )
    assert "done" in command("list", config, "--results", url).output


def test_a_sweep_lives_at_a_url(config: Path, cache: Path, tmp_path: Path):
    (tmp_path / "there").mkdir()
    a_sweep_lives_at(f"file://{tmp_path / 'there'}", config, cache)
    assert [path.name for path in list_files(tmp_path / "there")] == ["rows.parquet"]


@pytest.fixture
def storage(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An S3-compatible server on the loopback, with a bucket."""
    expected = "a server of this kind: pip install -e '.[s3-server]'"
    moto, boto3 = (pytest.importorskip(name, reason=expected) for name in ("moto.server", "boto3"))
    server = moto.ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    host, port = server.get_host_and_port()
    settings = {"AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_DEFAULT_REGION": "us-east-1"}
    for name, value in {**settings, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}.items():
        monkeypatch.setenv(name, value)
    boto3.client("s3").create_bucket(Bucket="bucket")
    yield "s3://bucket/results"
    server.stop()


@pytest.mark.long
def test_a_sweep_lives_in_storage_of_the_kind_of_s3(storage: str, config: Path, cache: Path):
    a_sweep_lives_at(storage, config, cache)


def test_a_place_that_cannot_be_read_or_written_is_named_and_nothing_is_lost(config: Path, cache: Path, tmp_path: Path):
    result = command("query", "SELECT 1", "--results", "nothing://there")
    assert (result.exit_code, "nothing://there" in result.output) == (2, True)
    (tmp_path / "there").write_text("a file")
    url = f"file://{tmp_path / 'there'}"
    result = command("run", config, "--results", url)
    assert (result.exit_code, "all results remain in" in result.output) == (1, True), result.output
    (tmp_path / "there").unlink()
    result = command("run", config, "--results", url)
    assert (result.exit_code, "1 of 1 runs are there already" in result.output) == (0, True), result.output
    assert len(list_files(tmp_path / "there")) == 1
