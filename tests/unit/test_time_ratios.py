"""Ratios of times to a reference method: the same on a machine of any speed, with an interval."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.error_times import list_curve_times, list_simulation_times
from springbench.harness.results.study_comparison import AgreementLevel, RunAgreement, compare_time_ratios
from springbench.harness.results.time_ratios import OTHER_MACHINE_FACTOR, compute_time_ratios, list_step_times

from tests.synthetic_accuracy_rows import build_curve_rows, build_snapshot_rows, build_work_rows, write_accuracy_rows


def build_steps(solver: str, seconds: float, **other: Any) -> list[dict[str, Any]]:
    shared = {"scene": "cloth", "size": 8, "solver": solver, "parameters": "{}", "phase": "step"} | other
    return [shared | {"frame": frame, "seconds": seconds * (1 + 0.01 * frame)} for frame in range(1, 9)]


def test_a_ratio_refers_to_the_same_scene_and_the_first_reference_solver() -> None:
    rows = [*build_steps("numba", 1e-3), *build_steps("sparse", 4e-3), *build_steps("sparse", 9e-3, size=16)]
    (ratio,) = compute_time_ratios(list_step_times(rows))
    assert (ratio.method[0], ratio.reference[0], ratio.task) == ("sparse", "numba", ("cloth", 8))
    assert ratio.ratio == pytest.approx(4.0)
    assert ratio.accepted_interval == pytest.approx((4.0 / OTHER_MACHINE_FACTOR, 4.0 * OTHER_MACHINE_FACTOR))


@pytest.mark.parametrize(
    ("speed", "slower", "level"),
    [(7.0, 1.0, AgreementLevel.CLOSE), (1.0, 1.9, AgreementLevel.CLOSE), (1.0, 2.2, AgreementLevel.DIFFERENT)],
)
def test_only_ratios_beyond_the_interval_differ(speed: float, slower: float, level: AgreementLevel) -> None:
    published = [*build_steps("numba", 1e-3), *build_steps("sparse", 4e-3)]
    here = [*build_steps("numba", 1e-3 * speed), *build_steps("sparse", 4e-3 * speed * slower)]
    (found,) = compare_time_ratios(list_step_times(published), list_step_times(here))
    assert found.level is level


@pytest.mark.parametrize(("interrupted", "level"), [(0, AgreementLevel.DIFFERENT), (2, AgreementLevel.UNDECIDED)])
def test_a_ratio_of_interrupted_steps_is_undecided(interrupted: int, level: AgreementLevel) -> None:
    published = [*build_steps("numba", 1e-3), *build_steps("sparse", 4e-3)]
    here = [*build_steps("numba", 1e-3), *build_steps("sparse", 4e-1)]
    here = [row | {"preempted": row["frame"] <= interrupted} for row in here]
    (found,) = compare_time_ratios(list_step_times(published), list_step_times(here))
    assert found.level is level


def test_steps_without_a_time_have_no_ratio() -> None:
    rows = [row | {"seconds": None} for row in build_steps("numba", 1.0)]
    assert compute_time_ratios(list_step_times([*rows, *build_steps("sparse", 1.0)])) == []


def build_study(slower: dict[str, float] | None = None, **other: Any) -> Iterator[dict[str, Any]]:
    """Rows of curves and simulations of three solvers, whose times are multiplied by factors."""
    yield from build_snapshot_rows("net", 24, "early")
    for solver in ("numba", "lbfgs", "newton"):
        for row in build_curve_rows("net", 24, "early", solver):
            yield row | {"seconds": [(slower or {}).get(solver, 1.0) * s for s in row["seconds"]]} | other
    for row in build_work_rows("net", 10):
        yield row | {"seconds": [(slower or {}).get(row["solver"], 1.0) * s for s in row["seconds"]]} | other


def compare_studies(home: Path, repeated: Iterator[dict[str, Any]]) -> list[RunAgreement]:
    theirs, ours = (
        read_accuracy(write_accuracy_rows(home / name, list(rows)))
        for name, rows in (("published", build_study()), ("repeated", repeated))
    )
    curves = compare_time_ratios(list_curve_times(theirs), list_curve_times(ours))
    return curves + compare_time_ratios(*list_simulation_times(theirs, ours))


def test_times_to_an_error_are_compared_with_the_reference_solver(tmp_path: Path) -> None:
    found = compare_studies(tmp_path, build_study({"numba": 3.0, "lbfgs": 3.0, "newton": 3.0, "hybrid": 3, "xpbd": 3}))
    assert {one.level for one in found} == {AgreementLevel.CLOSE}
    assert {one.title for one in found} >= {
        "net 24 early implicit-euler previous to 1e-3: lbfgs over numba",
        "net 10 1.0 to 1e-1: hybrid over numba",
    }


@pytest.mark.parametrize("factor", [2.5, 1 / 2.5])
@pytest.mark.parametrize("solver", ["lbfgs", "hybrid"])  # of curves, and of simulations
def test_a_planted_wrong_ratio_differs(tmp_path: Path, solver: str, factor: float) -> None:
    found = compare_studies(tmp_path, build_study({solver: factor}))
    wrong = {one.title.partition(": ")[2] for one in found if one.level is AgreementLevel.DIFFERENT}
    assert wrong == {f"{solver} over numba"}
    assert all(one.level is AgreementLevel.DIFFERENT for one in found if one.title.endswith(f"{solver} over numba"))


def test_a_wrong_ratio_of_interrupted_rounds_is_undecided(tmp_path: Path) -> None:
    found = compare_studies(tmp_path, build_study({"lbfgs": 9.0, "hybrid": 9.0}, preempted=True))
    assert {one.level for one in found} == {AgreementLevel.CLOSE, AgreementLevel.UNDECIDED}
    assert "other processes interrupted it" in next(o for o in found if o.level is AgreementLevel.UNDECIDED).explanation


@pytest.mark.parametrize(("others", "level"), [(True, AgreementLevel.UNDECIDED), (False, AgreementLevel.DIFFERENT)])
def test_a_wrong_ratio_is_undecided_where_many_others_were_interrupted(
    tmp_path: Path, others: bool, level: AgreementLevel
) -> None:
    rows = [row | {"preempted": others and row.get("solver") == "newton"} for row in build_study({"lbfgs": 9.0})]
    found = compare_studies(tmp_path, iter(rows))
    assert {one.level for one in found if "lbfgs over" in one.title} == {level}


def test_rounds_that_reach_into_the_interval_leave_a_ratio_undecided(tmp_path: Path) -> None:
    slow = list(build_study({"lbfgs": 9.0}))
    rows = [
        row | {"seconds": [old["seconds"][0], *row["seconds"][1:]]} if row.get("seconds") else row
        for row, old in zip(slow, build_study(), strict=True)
    ]
    found = compare_studies(tmp_path, iter(rows))
    levels = {one.level for one in found if "lbfgs over" in one.title}
    assert levels == {AgreementLevel.UNDECIDED}


def test_a_part_of_the_settings_is_compared_with_the_same_ones_published(tmp_path: Path) -> None:
    drawn = [row for row in build_study() if row["kind"] != "work" or row["time_step"] < 1 / 100]
    found = compare_studies(tmp_path, iter(drawn))
    assert any(one.title.endswith("hybrid over numba") for one in found)
    assert {one.level for one in found} == {AgreementLevel.CLOSE}
