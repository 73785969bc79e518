"""A published study is repeated: equal runs agree, and a changed result is found."""

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from springbench.harness.cli.commands.published import report_agreement
from springbench.harness.cli.main import app
from springbench.harness.experiments.archive import archive_verification
from springbench.harness.experiments.archive.study_publication import write_published_table, write_study_file
from springbench.harness.experiments.archive.study_reproduction import (
    draw_from_groups,
    draw_sample,
    omit_missing_software,
)
from springbench.harness.report.published_comparison import compare_with_published
from springbench.harness.results.published_set import read_study
from springbench.harness.results.study_comparison import (
    AgreementLevel,
    RunAgreement,
    compare_repeated_curve,
    compare_repeated_run,
    compare_time_ratios,
    group_curves,
)
from springbench.harness.results.time_ratios import MethodTimes
from typer.testing import CliRunner, Result

from tests.contracts.hostile import scene

SWEEP = """
scenes: [cloth.yaml]
sizes: [4]
solvers: [sparse, dense]
options: {rounds: 1, frames: 3, record: false, pictures: false, max_iterations: 3, timing: TIMING}
"""


def command(*arguments: object) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


def publish_sweep(home: Path, timing: str) -> Path:
    """Run a sweep and publish it; return the published set."""
    (home / "cloth.yaml").write_text(scene())
    (home / "sweep.yaml").write_text(SWEEP.replace("TIMING", timing))
    published = home / "published"
    for arguments in (
        ("run", home / "sweep.yaml", "--results", home / "results"),
        ("publish-study", home / "results" / "sweep", "--published", published),
    ):
        result = command(*arguments)
        assert result.exit_code == 0, result.output
    return published


@pytest.fixture(scope="module")
def untimed_study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return publish_sweep(tmp_path_factory.mktemp("untimed"), "none")


def build_curve(iterations: list[int], stationarity: list[float], status: str = "ok") -> list[dict[str, Any]]:
    names = {"kind": "curve", "scene": "cloth", "size": 4, "snapshot": "early", "solver": "numba", "status": status}
    return [names | {"iteration": k, "stationarity": s} for k, s in zip(iterations, stationarity, strict=True)]


@pytest.mark.parametrize(
    ("repeated", "level"),
    [
        (build_curve([0, 10, 20, 30], [1.0, 0.05, 0.005, 0.0003]), AgreementLevel.IDENTICAL),
        (build_curve([0, 10, 20, 30], [1.0, 0.04, 0.005, 0.0003]), AgreementLevel.CLOSE),
        (build_curve([0, 10, 20, 30], [1.0, 0.05, 0.02, 0.0003]), AgreementLevel.CLOSE),  # one sample later
        (build_curve([0, 10, 20, 30, 40], [1.0, 0.5, 0.2, 0.05, 0.0003]), AgreementLevel.DIFFERENT),
        (build_curve([0, 10, 20, 30], [1.0, 0.05, 0.005, 0.00002]), AgreementLevel.DIFFERENT),  # another one reached
        (build_curve([0], [1.0], "diverged"), AgreementLevel.DIFFERENT),
        (build_curve([0, 10], [1.0, 0.05], "time-limit"), AgreementLevel.CLOSE),
        (build_curve([0, 10, 20, 30], [1.0, 0.5, 0.2, 0.04], "time-limit"), AgreementLevel.DIFFERENT),
    ],
)
def test_curves_agree_by_the_iterations_to_each_stationarity(repeated: list[dict[str, Any]], level: AgreementLevel):
    published = build_curve([0, 10, 20, 30], [1.0, 0.05, 0.005, 0.0003])
    assert compare_repeated_curve(published, repeated).level == level
    assert list(group_curves([*published, {"kind": "minimum"}]).values()) == [published]


@pytest.mark.slow
def test_a_study_agrees_with_itself(untimed_study: Path, tmp_path: Path) -> None:
    again = ("reproduce", "sweep", "--published", untimed_study, "--results", tmp_path)
    result = command(*again)
    assert result.exit_code == 0, result.output
    assert "sweep: 2 runs; when it was published this took" in result.output
    assert "2 runs: 2 identical\n" in result.output
    assert "2 of 2 runs are there already" in command(*again).output
    quick = command(*again, "--quick", "--seed", 3)
    assert "a tenth of 2 runs, drawn by --seed 3" in quick.output
    assert "1 runs: 1 identical" in quick.output


@pytest.mark.slow
def test_another_number_of_iterations_does_not_agree(untimed_study: Path, tmp_path: Path) -> None:
    study = read_study(untimed_study / "sweep")
    table = study.read_table("rows")
    changed = [9 * count if count else count for count in table["num_iterations"].to_pylist()]
    at = table.column_names.index("num_iterations")
    forged = tmp_path / "published" / "sweep"
    forged.mkdir(parents=True)
    write_published_table(forged / "runs.parquet", table.set_column(at, "num_iterations", pa.array(changed)))
    write_study_file(forged, study.metadata | {"config": str(study.config_path)})
    result = command("reproduce", "all", "--published", forged.parent, "--results", tmp_path)
    assert result.exit_code == 1, result.output
    assert "took 27 iterations, here 3" in result.output
    assert "does not agree" in result.output


@pytest.mark.slow
def test_an_entry_is_verified_and_a_changed_one_is_not(
    untimed_study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive_verification, "MAX_RATIO_SAME_MACHINE", math.inf)  # steps of some microseconds
    entry = tmp_path / "entries" / "mine.zip"
    entry.parent.mkdir()
    published = command("publish", untimed_study.parent / "results", "-o", entry)
    assert published.exit_code == 0, published.output
    again = ("reproduce", "entries", "--published", tmp_path, "--seed", 1)
    result = command(*again)
    assert result.exit_code in (0, 3), result.output  # 3: a busy machine interrupts steps, whose times then say nothing
    assert "all checksums match" in result.output
    assert "positions: confirmed" in result.output
    with zipfile.ZipFile(entry, "a") as archive:
        archive.writestr("results/more.txt", "not published")
    assert command(*again).exit_code == 1


@pytest.mark.slow
def test_own_runs_are_listed_next_to_the_published_ones(tmp_path: Path) -> None:
    published = publish_sweep(tmp_path, "exclusive")
    (dense,) = (
        one
        for one in compare_with_published(tmp_path / "results", [read_study(published / "sweep")])
        if one.solver == "dense"
    )
    assert dense.reference == "sparse"
    assert dense.own_ratio == dense.published_ratio, "the same rows have the same ratio"
    assert dense.own_iterations == dense.published_iterations == 3
    result = command("compare", tmp_path / "results", "--published", published)
    assert result.exit_code == 0, result.output
    assert "dense" in result.output


def test_a_changed_table_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "published" / "study"
    folder.mkdir(parents=True)
    write_published_table(folder / "runs.parquet", pa.table({"run_id": ["a"]}))
    metadata = {"config": "sweep.yaml", "is_timed": False, "runs": 1, "duration_seconds": 1, "command": "run"}
    write_study_file(folder, metadata | {"machines": [{"cpu": "a", "cores": 1}]})
    pq.write_table(pa.table({"run_id": ["b"]}), folder / "runs.parquet")
    result = command("reproduce", "study", "--published", folder.parent)
    assert result.exit_code == 2
    assert "differs from its checksum in study.json" in result.output


def test_an_unknown_study_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    folder = tmp_path / "hard"
    folder.mkdir()
    metadata = {"config": "hard.yaml", "command": "springbench run hard.yaml", "is_timed": False, "runs": 1}
    metadata |= {"duration_seconds": 1, "machines": [{}], "files": {}}
    (folder / "study.json").write_text(json.dumps(metadata))
    result = command("reproduce", "hart", "--published", tmp_path)
    assert result.exit_code == 2
    assert "did you mean 'hard'?" in result.output
    (folder / "study.json").write_text("{}")
    assert command("reproduce", "hard", "--published", tmp_path).exit_code == 2
    assert command("compare", tmp_path, "--published", tmp_path / "nothing").exit_code == 2


def test_a_large_entry_is_refused(tmp_path: Path) -> None:
    entry = tmp_path / "entries" / "mine.zip"
    entry.parent.mkdir()
    entry.write_bytes(b"0" * (2**20 + 1))
    result = command("reproduce", "entries", "--published", tmp_path)
    assert result.exit_code == 1
    assert "takes 1,048,577 bytes" in result.output


def test_a_tenth_is_drawn_by_its_seed() -> None:
    items = list(range(95))
    assert draw_sample(items, None) == items
    assert len(draw_sample(items, 1)) == 10
    assert draw_sample(items, 1) == draw_sample(items, 1)
    assert draw_sample(items, 1) != draw_sample(items, 2)


def test_a_tenth_is_drawn_from_few_groups() -> None:
    items = list(range(95))
    drawn = draw_from_groups(items, lambda item: item % 12, 1)
    assert len(drawn) == len(set(drawn)) == 10
    assert len({item % 12 for item in drawn}) == 2, "a group has 7 or 8 items"
    assert drawn == draw_from_groups(items, lambda item: item % 12, 1) != draw_from_groups(items, lambda k: k % 12, 2)
    assert draw_from_groups(items, lambda item: item % 12, None) == items


ROW: dict[str, Any] = {
    "scene": "cloth",
    "size": 8,
    "solver": "newton",
    "frame": 1,
    "num_iterations": 40,
    "termination_reason": "max-iter",
    "residual": 1e-3,
    "residual_initial": 1.0,
    "stationarity": None,
}


@pytest.mark.parametrize(
    ("change", "level"),
    [
        ({}, AgreementLevel.IDENTICAL),
        ({"num_iterations": 43}, AgreementLevel.CLOSE),
        ({"num_iterations": 46}, AgreementLevel.DIFFERENT),
        ({"residual": 1.5e-3}, AgreementLevel.CLOSE),
        ({"residual": 2.5e-3}, AgreementLevel.DIFFERENT),
        ({"residual": 0.6e-3}, AgreementLevel.CLOSE),
        ({"residual": 0.4e-3}, AgreementLevel.DIFFERENT),
        ({"residual": 1e-7, "termination_reason": "converged"}, AgreementLevel.CLOSE),
    ],
)
def test_a_step_agrees_within_the_tolerances(change: dict[str, Any], level: AgreementLevel) -> None:
    assert compare_repeated_run([ROW], [ROW | change], lambda run: "ok").level is level


def test_another_outcome_differs() -> None:
    outcomes = iter(("right", "not converged"))
    found = compare_repeated_run([ROW], [ROW], lambda run: next(outcomes))
    assert found.level is AgreementLevel.DIFFERENT
    assert found.explanation == "published as 'right', here 'not converged'"


@pytest.mark.parametrize(("ratio", "agrees"), [(0.49, False), (0.5, True), (2.0, True), (2.01, False)])
def test_a_ratio_agrees_within_the_published_interval(ratio: float, agrees: bool) -> None:
    reference = MethodTimes(("cloth", 8), ("sparse",), {0: 1.0, 1: 1.0}, False)
    published = [reference, reference._replace(method=("newton",))]
    repeated = [reference, published[1]._replace(seconds={0: ratio, 1: ratio})]
    (found,) = compare_time_ratios(published, repeated)
    assert found.level is (AgreementLevel.CLOSE if agrees else AgreementLevel.DIFFERENT)
    assert compare_time_ratios(published, [one._replace(task=("cloth", 9)) for one in repeated]) == []


@pytest.mark.parametrize(("different", "agrees"), [(0, True), (2, True), (3, False)])
def test_two_in_a_hundred_runs_may_differ(different: int, agrees: bool) -> None:
    levels = [AgreementLevel.DIFFERENT] * different + [AgreementLevel.CLOSE] * (100 - different)
    assert report_agreement("study", [RunAgreement("run", level) for level in levels], []) == (0 if agrees else 1)
    assert report_agreement("study", [], []) == 1


def test_ratios_that_the_load_leaves_undecided_do_not_fail() -> None:
    runs = [RunAgreement("run", AgreementLevel.IDENTICAL)]
    undecided = [RunAgreement("ratio", AgreementLevel.UNDECIDED, "interrupted")] * 3
    close = [RunAgreement("ratio", AgreementLevel.CLOSE)] * 97
    assert report_agreement("study", runs, undecided + close) == 3
    assert report_agreement("study", runs, undecided[:1] + close) == 0
    assert report_agreement("study", runs, [RunAgreement("ratio", AgreementLevel.DIFFERENT), *undecided]) == 1


def test_runs_without_their_optional_software_are_not_compared() -> None:
    def build_rows(solver: str, status: str) -> list[dict[str, Any]]:
        return [{"solver": solver, "status": status, "reason": f"{solver} is not installed"}]

    ok = {solver: build_rows(solver, "ok") for solver in ("eigen", "newton", "mujoco")}
    refused = {solver: build_rows(solver, "unsupported") for solver in ok}
    pairs = [(ok["eigen"], refused["eigen"]), (ok["newton"], refused["newton"]), (ok["mujoco"], refused["mujoco"])]
    pairs += [(ok["mujoco"], ok["mujoco"])]  # it is installed, so that its other run must not be refused
    remarks: list[str] = []
    assert omit_missing_software(pairs, remarks.append) == pairs[1:]
    assert remarks == ["1 runs of eigen are not compared: eigen is not installed"]


@pytest.mark.slow
def test_an_untimed_study_publishes_no_times(untimed_study: Path) -> None:
    columns = set(read_study(untimed_study / "sweep").read_table("rows").column_names)
    assert {"num_iterations", "residual"} <= columns
    assert not columns & {"seconds", "cpu_seconds", "load_average", "cold_seconds"}
