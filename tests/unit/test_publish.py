"""Publishing results and verifying them: what was changed is found, and what is in an archive comes out again."""

import json
import re
import subprocess
import zipfile
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from springbench.harness.cli.main import app
from springbench.harness.console import get_error_console
from springbench.harness.execution.progress_display import ProgressLines
from springbench.harness.experiments.archive import archive_unpacking, archive_verification
from springbench.harness.experiments.archive.archive_verification import (
    ClaimVerdict,
    PublishedRun,
    ResultRow,
    VerifiedClaim,
)
from springbench.harness.results import parquet_rows
from typer.testing import CliRunner, Result

from tests.contracts.hostile import scene
from tests.synthetic_run_rows import build_dummy_rows

SWEEP = """
scenes: [cloth.yaml]
sizes: [4]
solvers: [sparse, dense]
options: {rounds: 1, record: false, pictures: false, max_iterations: 3}
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
        result = command(*arguments)
        assert result.exit_code == 0, result.output
    return home


def change_archive(archive: Path, into: Path, change: Callable[[dict[str, bytes]], None], *, sums: bool) -> Path:
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
def test_published_archives_unpack_and_verify(home: Path, name: str, tmp_path: Path):
    with archive_unpacking.unpack_archive(home / name) as folder:
        subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=folder, check=True)
        assert archive_verification.verify_checksums(folder) == []
        runs, wrong = archive_verification.load_published_runs(folder, print, with_user_code=False)
        assert [one.title for one in runs] == ["cloth 4 dense", "cloth 4 sparse"]
        assert wrong == []
        taken = archive_verification.sample_runs(runs, seed=1)
        claims = archive_verification.verify_reruns(
            taken, archive_verification.rerun_published(taken, tmp_path, ProgressLines(get_error_console()))
        )
        listed = command("list", folder / "configs" / "sweep" / "sweep.yaml", "--results", folder / "results")
        assert listed.output.count("done") == 2
    arguments = [*map(str, claims)]
    for solver in ("dense", "sparse"):
        assert f"cloth 4 {solver}, positions: confirmed (2 steps, to the bit)" in arguments
        assert any(line.startswith(f"cloth 4 {solver}, other columns: confirmed (") for line in arguments), arguments
        assert any(line.startswith(f"cloth 4 {solver}, time of a step: ") for line in arguments)
    assert "times as long as" in claims[-1].subject


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

    result = command("verify-archive", change_archive(home / "x.zip", tmp_path / "y.zip", change, sums=False))
    assert result.exit_code == 1
    for line in ("sweep.yaml: refuted (was changed)", "mine.py: refuted (was not", "(missing)"):
        assert line in result.output
    assert "repeating" not in result.output


@pytest.fixture(scope="module")
def repeated_runs(
    home: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[PublishedRun], list[list[ResultRow]]]:
    """The published runs, dense and sparse, and what they leave when they are done again."""
    with archive_unpacking.unpack_archive(home / "x.zip") as folder:
        runs, _ = archive_verification.load_published_runs(folder, print, with_user_code=False)
        return runs, archive_verification.rerun_published(
            runs, tmp_path_factory.mktemp("again"), ProgressLines(get_error_console())
        )


def scale_column(name: str, factor: float) -> Callable[[ResultRow], ResultRow]:
    return lambda row: row if row[name] is None else row | {name: row[name] * factor}


def only(change: Callable[[ResultRow], ResultRow], **at: Any) -> Callable[[ResultRow], ResultRow]:
    return lambda row: change(row) if all(row[name] == value for name, value in at.items()) else row


FORGED_COLUMNS: dict[str, tuple[Callable[[ResultRow], ResultRow], str]] = {
    "solvers exchanged": (
        lambda row: row | {"solver": "sparse" if row["solver"] == "dense" else "dense"},
        "names and options",
    ),
    "another scene": (lambda row: row | {"scene": "silk"}, "names and options"),
    "another size": (lambda row: row | {"size": 64}, "names and options"),
    "other parameters": (lambda row: row | {"parameters": '{"a": 1}'}, "names and options"),
    "another time step": (scale_column("time_step", 0.5), "names and options"),
    "more iterations allowed": (scale_column("max_iterations", 10), "names and options"),
    "an integrator": (lambda row: row | {"integrator": "bdf2"}, "names and options"),
    "one row of another solver": (only(lambda row: row | {"solver": "fast"}, phase="step", frame=2), "names and"),
    "small residuals": (scale_column("residual", 1e-6), "columns: .*residual"),
    "small last residuals": (scale_column("residual_last", 1e-6), "columns: .*residual_last"),
    "halved energies": (scale_column("energy_springs", 0.5), "columns: .*energy_springs"),
    "an objective": (only(scale_column("objective", 0.999), frame=2), "columns: .*objective"),
    "fewer iterations": (only(scale_column("num_iterations", 2), phase="step"), "columns: .*num_iterations"),
    "another end of iterations": (
        lambda row: row | {"termination_reason": row["termination_reason"] and "converged"},
        "columns: .*termination_reason",
    ),
    "more vertices": (scale_column("vertices", 100), "columns: .*vertices"),
    "a smaller strain": (scale_column("max_strain", 0.9), "columns: .*max_strain"),
    "fewer numbers in the factor": (scale_column("nnz_system", 2), "columns: .*nnz_system"),
    "a family": (lambda row: row | {"family": "mine"}, "columns: .*family"),
    "positions of one step": (
        only(lambda row: row | {"positions_digest": "0" * 64}, frame=2),
        "positions: .*step 2 of 2",
    ),
    "a failed rival": (
        lambda row: row | ({"status": "diverged", "reason": "it is bad"} if row["solver"] == "dense" else {}),
        "end: refuted",
    ),
    "all 1,000 times as fast": (scale_column("seconds", 1e-3), "time of a step: refuted"),
    "all 1,000 times as slow": (scale_column("seconds", 1e3), "time of a step: refuted"),
    "no time": (lambda row: row | {"seconds": None}, "time of a step: refuted"),
    "no time at all": (scale_column("seconds", 0.0), "time of a step: refuted"),
    "one 2.5 times as fast": (only(scale_column("seconds", 0.4), solver="dense"), "takes .*refuted"),
    "another frame": (only(lambda row: row | {"frame": 7}, frame=2), "positions: .*refuted|positions: refuted"),
    "another phase": (only(lambda row: row | {"phase": "magic"}, phase="prepare"), "a repeat has no magic"),
    "a phase that is null": (only(lambda row: row | {"phase": None}, phase="prepare"), "a repeat has no None"),
    "a frame that is null": (only(lambda row: row | {"frame": None}, phase="step"), "positions: refuted"),
    "a round that is null": (lambda row: row | {"round": None}, "a repeat has no"),
}


def claims_of(runs: list[PublishedRun], new: list[list[ResultRow]]) -> list[str]:
    """All claims that do not hold, where nothing here was interrupted."""
    undisturbed = [[row | {"preempted": False} for row in found] for found in new]
    named = [claim for one in runs if (claim := archive_verification._verify_options(one))]
    return [
        str(claim)
        for claim in (*named, *archive_verification.verify_reruns(runs, undisturbed))
        if claim.verdict is ClaimVerdict.FAIL
    ]


def with_rows_of(runs: list[PublishedRun], new: list[list[ResultRow]]) -> list[PublishedRun]:
    """The runs with rows of this very repetition, whose times have no noise."""
    undisturbed = [[row | {"preempted": False} for row in found] for found in new]
    return [replace(one, rows=found) for one, found in zip(runs, undisturbed, strict=True)]


@pytest.mark.parametrize("kind", FORGED_COLUMNS)
def test_a_forged_column_is_refuted(kind: str, repeated_runs: tuple[list[PublishedRun], list[list[ResultRow]]]):
    runs, new = repeated_runs
    honest = with_rows_of(runs, new)
    assert claims_of(honest, new) == []
    change, said = FORGED_COLUMNS[kind]
    forged = [replace(one, rows=[change(row) for row in one.rows]) for one in honest]
    refuted = claims_of(forged, new)
    assert any(re.search(said, line) for line in refuted), refuted


def test_a_repetition_without_a_recording_has_another_id(
    repeated_runs: tuple[list[PublishedRun], list[list[ResultRow]]],
):
    runs, new = repeated_runs
    renamed = [[row | {"run_id": "0" * 12} for row in found] for found in new]
    assert claims_of(with_rows_of(runs, new), renamed) == []


@pytest.mark.parametrize(("again", "is_met"), [("4 (7.5 ms, 100% of cost)", True), ("5 (0.2 ms, 100% of cost)", False)])
def test_times_of_phases_are_not_confirmed_but_their_iterations_are(
    again: str, is_met: bool, repeated_runs: tuple[list[PublishedRun], list[list[ResultRow]]]
):
    runs, new = repeated_runs
    published = [
        replace(one, rows=[row | {"solver_phases": "lbfgs 4 (0.2 ms, 100% of cost)"} for row in one.rows])
        for one in with_rows_of(runs, new)
    ]
    repeated = [[row | {"solver_phases": f"lbfgs {again}"} for row in found] for found in new]
    refuted = claims_of(published, repeated)
    assert not refuted if is_met else any("columns: " in line and "solver_phases" in line for line in refuted)


def test_missing_or_repeated_rows_are_refuted(repeated_runs: tuple[list[PublishedRun], list[list[ResultRow]]]):
    runs, new = repeated_runs
    for one, here in zip(runs, new, strict=True):
        fewer = replace(one, rows=[row for row in here if row["phase"] != "step" or row["frame"] == 1])
        assert any("positions" in line for line in claims_of([fewer], [here]))
        better = [row | {"residual": 1e-12} for row in here if row["phase"] == "step"]
        doubled = replace(one, rows=[*better, *here])
        assert any("residual" in line for line in claims_of([doubled], [here]))


def test_elsewhere_what_differs_refutes_nothing_and_confirms_nothing(
    repeated_runs: tuple[list[PublishedRun], list[list[ResultRow]]],
):
    runs, new = repeated_runs
    for change in (
        scale_column("residual", 0.5),
        scale_column("seconds", 1e-3),
        lambda row: row | {"positions_digest": "0"},
    ):
        there = [replace(one, rows=[change(row) | {"machine_id": "another"} for row in one.rows]) for one in runs]
        assert claims_of(there, new) == []
        assert ClaimVerdict.INCONCLUSIVE in {claim.verdict for claim in archive_verification.verify_reruns(there, new)}


def test_runs_that_no_config_requests_cannot_be_decided(home: Path, tmp_path: Path):
    def change(content: dict[str, bytes]) -> None:
        made_up = [row | {"run_id": "f" * 12, "solver": "magic"} for row in build_dummy_rows(1)]
        content["results/sweep/rows/cloth-4-magic.parquet"] = parquet_rows.encode_rows(made_up)

    result = command(
        "verify-archive", change_archive(home / "x.zip", tmp_path / "y.zip", change, sums=True), "--seed", "1"
    )
    assert "1 of 3 runs of sweep: undecided (the config expands to no such run)" in result.output
    assert result.exit_code == (1 if "refuted" in result.output else 3), result.output
    assert "columns that a repeated run cannot confirm: " in result.output


def test_false_rows_with_valid_checksums_are_refuted(home: Path, tmp_path: Path):
    def change(content: dict[str, bytes]) -> None:
        for name in [name for name in content if name.endswith(".parquet")]:
            (tmp_path / "x.parquet").write_bytes(content[name])
            lies = pq.read_table(tmp_path / "x.parquet").to_pylist()
            parquet_rows.write_rows(
                tmp_path / "x.parquet",
                [row | {"positions_digest": row["positions_digest"] and "0" * 64} for row in lies],
            )
            content[name] = (tmp_path / "x.parquet").read_bytes()

    result = command("verify-archive", change_archive(home / "x.zip", tmp_path / "y.zip", change, sums=True))
    assert result.exit_code == 1, result.output
    assert "positions: refuted (they differ from step 1 of 2 on)" in result.output


def test_an_archive_whose_results_lead_to_another_config_is_refused(home: Path, tmp_path: Path):
    def change(content: dict[str, bytes]) -> None:
        content["results/sweep/.config"] = str(home / "sweep.yaml").encode()

    result = command("verify-archive", change_archive(home / "x.zip", tmp_path / "y.zip", change, sums=True))
    assert (result.exit_code, "points to a file outside of the archive" in result.output) == (2, True)


BAD: dict[str, Callable[[Path], object]] = {
    "not there": lambda path: None,
    "text": lambda path: path.write_text("results"),
    "another archive": lambda path: zipfile.ZipFile(path, "w").close(),
}


@pytest.mark.parametrize("kind", BAD)
def test_what_is_no_such_archive_is_the_users_mistake(tmp_path: Path, kind: str):
    BAD[kind](tmp_path / "x.zip")
    result = command("verify-archive", tmp_path / "x.zip")
    assert (result.exit_code, "springbench: " in result.output) == (2, True)


def test_damaged_rows_are_not_published(home: Path, tmp_path: Path):
    (tmp_path / "sweep" / "rows").mkdir(parents=True)
    (tmp_path / "sweep" / "rows" / "a.parquet").write_bytes(b"PAR1")
    result = command("publish", tmp_path, "-o", tmp_path / "x.zip")
    assert (result.exit_code, "a.parquet" in result.output) == (2, True)
    assert not (tmp_path / "x.zip").exists()
    assert command("publish", home / "results", "-o", tmp_path / "x.tar").exit_code == 2


def claim(home: Path, factor: float, *, interrupted: bool = False, machine: str = "00000000") -> VerifiedClaim:
    """What is said of a ratio that was 1 and is `factor`."""
    with archive_unpacking.unpack_archive(home / "x.zip") as folder:
        run = archive_verification.load_published_runs(folder, print, with_user_code=False)[0][0].run
    old = [row | {"preempted": False} for row in build_dummy_rows(1)]
    there = (PublishedRun(old, run), PublishedRun(old, run.replace_options(size=5)))
    slower = [row | {"seconds": row["seconds"] * factor, "preempted": interrupted} for row in old]
    here = [[row | {"machine_id": machine} for row in found] for found in (slower, old)]
    return archive_verification._verify_time_ratio(there, (here[0], here[1]))


def test_a_ratio_is_met_or_not_or_inconclusive(home: Path):
    assert claim(home, 1.2).verdict is claim(home, 1 / 1.2).verdict is ClaimVerdict.PASS
    assert claim(home, 1.4).verdict is claim(home, 1 / 1.4).verdict is ClaimVerdict.FAIL
    assert claim(home, 1.4, interrupted=True).verdict is ClaimVerdict.INCONCLUSIVE
    assert claim(home, 1.4, machine="another").verdict is ClaimVerdict.PASS
    assert claim(home, 2.4, machine="another").verdict is ClaimVerdict.INCONCLUSIVE


def test_a_tenth_is_chosen_and_each_has_another_solver_for_comparison(home: Path):
    with archive_unpacking.unpack_archive(home / "x.zip") as folder:
        (a, b), _ = archive_verification.load_published_runs(folder, print, with_user_code=False)
    runs = [replace(one, run=one.run.replace_options(size=size)) for size in range(10) for one in (a, b)]
    for seed in range(20):
        taken = archive_verification.sample_runs(runs, seed)
        assert len(taken) in (2, 4)
        assert all(sum(other.comparison_group == one.comparison_group for other in taken) == 2 for one in taken)
    assert len({one.title for seed in range(20) for one in archive_verification.sample_runs(runs, seed)}) > 8
    assert archive_verification.sample_runs([], 0) == []
