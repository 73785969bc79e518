"""What the accuracy report computes from rows whose answers are known."""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import inf, isnan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, ConvergenceCurve, without_short_curves
from springbench.harness.report.accuracy.accuracy_findings import build_curve_summary, list_failures, summarise_findings
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.liu2013_comparison import (
    LIU2013_FIGURE_2,
    LIU2013_FIGURE_3,
    MAX_ERROR_RATIO,
    compare_with_paper,
)
from springbench.harness.report.accuracy.performance_profiles import (
    compute_cumulative_share,
    compute_data_profile_ratios,
    compute_performance_ratios,
    describe_omitted_solvers,
)
from springbench.harness.report.accuracy.size_scaling import fit_scalings
from springbench.harness.report.accuracy.time_to_accuracy import (
    GAP_TARGETS,
    compute_amortised_seconds,
    describe_crossings,
    find_time_to_accuracy,
    format_duration,
    format_gap,
    is_contested,
)
from springbench.harness.report.accuracy.work_precision import find_default_setting, find_pareto_front

from tests import synthetic_accuracy_rows as made

COST, SETUP = made.SYNTHETIC_METHODS["numba"]["cost"], made.SYNTHETIC_METHODS["numba"]["setup"]


def table(folder: Path, rows: Sequence[dict[str, Any]]) -> AccuracyData:
    return read_accuracy(made.write_accuracy_rows(folder, rows))


def net(folder: Path, *solvers: str, size: int = 10, **more: Any) -> AccuracyData:
    """One step of a net."""
    problem = made.build_snapshot_rows("net", size, "early", **more)
    return table(folder, [*problem, *(row for s in solvers for row in made.build_curve_rows("net", size, "early", s))])


def by_solver(found: AccuracyData) -> dict[str, ConvergenceCurve]:
    return {curve.solver: curve for curve in found.curves}


def test_gaps_are_relative_to_the_best_minimum_and_the_current_positions(tmp_path: Path) -> None:
    curve = by_solver(net(tmp_path, "numba"))["numba"]
    expected = made.compute_gaps(0.93, curve.iterations.astype(int).tolist(), 1.0)
    # The energies are of order 1 J and rounded to 1e-16 of that, the gaps to 2e-16 of their scale.
    np.testing.assert_allclose(curve.gap, expected, rtol=1e-9, atol=1e-15)
    assert curve.problem.roundoff_gap == pytest.approx(40.0 * np.finfo(float).eps / made.ENERGY_DROP)
    assert curve.max_vertex_error[0] == pytest.approx(0.3 * 10), "0.3 m in mean rest lengths of 1/10 m"


def test_a_lower_minimum_mends_all_gaps_without_a_new_run(tmp_path: Path) -> None:
    rows = list(made.build_curve_rows("net", 10, "early", "numba"))
    before = table(tmp_path / "a", [*made.build_snapshot_rows("net", 10, "early"), *rows])
    lower = made.build_snapshot_rows("net", 10, "early")[1] | {
        "objective": made.LOWEST_ENERGY - 0.5,
        "minimum_id": "deeper",
    }
    after = table(tmp_path / "b", [*made.build_snapshot_rows("net", 10, "early"), lower, *rows])
    assert before.curves[0].minimum_index == 0
    assert after.curves[0].minimum_index == 1, "the minimum that the rows called the lowest is the second now"
    # In the limit the old minimum is 0.5 J above the new one, of 2.5 J from the start.
    assert after.curves[0].gap[-1] == pytest.approx(0.5 / 2.5)


@pytest.mark.parametrize("target", GAP_TARGETS)
def test_an_accuracy_is_reached_at_the_first_whole_iteration_at_or_below_it(tmp_path: Path, target: float) -> None:
    reached = find_time_to_accuracy(by_solver(net(tmp_path, "numba"))["numba"], target)
    assert reached is not None
    exact = int(np.ceil(np.log(target) / np.log(0.93)))  # the gap falls by 0.93 an iteration, between recorded ones too
    assert reached.iteration == exact
    assert reached.seconds == pytest.approx(COST * 100 * exact)
    # Rounds of 0.97, 1 and 1.1 times that: their quartiles.
    assert reached.lower == pytest.approx(0.985 * reached.seconds)
    assert reached.upper == pytest.approx(1.05 * reached.seconds)


def test_set_up_is_spread_over_the_steps(tmp_path: Path) -> None:
    curve = by_solver(net(tmp_path, "numba"))["numba"]
    alone = compute_amortised_seconds(curve, 1e-3)
    assert [compute_amortised_seconds(curve, 1e-3, n) - alone for n in (1, 10, 100)] == pytest.approx(
        [SETUP * 100, SETUP * 10, SETUP], rel=1e-6
    )


@pytest.mark.parametrize(
    ("status", "seconds"),
    [("diverged", inf), ("failed", inf), ("unsupported", inf), ("time-limit", 4.8e-4), ("no-progress", 4.8e-4)],
)
def test_failures_reach_nothing_and_time_limits_preserve_earlier_iterates(
    tmp_path: Path, status: str, seconds: float
) -> None:
    rows = [
        row | {"status": status} for row in made.build_curve_rows("net", 10, "early", "numba") if row["kind"] == "curve"
    ]
    curve = table(tmp_path, [*made.build_snapshot_rows("net", 10, "early"), *rows]).curves[0]
    assert compute_amortised_seconds(curve, 1e-3) == pytest.approx(seconds)  # 96 iterations of 5e-8 s a vertex
    assert isnan(curve.warm_seconds)


def test_a_solver_in_another_minimum_never_reaches_the_gaps_below_it(tmp_path: Path) -> None:
    rows = [
        *made.build_snapshot_rows("net", 10, "early", minima_count=2),
        *made.build_curve_rows("net", 10, "early", "newton", minimum_index=1),
    ]
    curve = table(tmp_path, rows).curves[0]
    assert curve.minimum_index == 1
    assert find_time_to_accuracy(curve, 1e-1) is not None, "its minimum is 0.05 of the scale above the lowest"
    assert find_time_to_accuracy(curve, 1e-2) is None


@pytest.mark.parametrize(
    ("change", "doubt"),
    [
        pytest.param({"is_certified": False}, "not certified", id="not certified"),
        pytest.param({"objective": None}, "no minimum is known", id="none known"),
        pytest.param({"objective": made.LOWEST_ENERGY + 0.3}, "is below", id="a solver's energy is below"),
        pytest.param({}, "", id="certified"),
    ],
)
def test_an_uncertified_reference_is_reported_and_not_used(tmp_path: Path, change: dict, doubt: str) -> None:
    problem, minimum = made.build_snapshot_rows("net", 10, "early")
    found = table(tmp_path, [problem, minimum | change, *made.build_curve_rows("net", 10, "early", "numba")])
    assert (doubt in found.problems[0].uncertified_reason) if doubt else not found.problems[0].uncertified_reason
    assert len(compute_performance_ratios(found, 1e-2)["numba"]) == (0 if doubt else 1), (
        "profiles take certified steps alone"
    )
    assert np.nanmin(found.curves[0].gap) < 1e-9, "the gaps shown refer to the lowest energy that is known"
    assert ("References that are not certified" in summarise_findings(found)) == bool(doubt)


def test_crossings_name_both_solvers_and_both_times(tmp_path: Path) -> None:
    # To 3e-1 sparse takes 16 iterations of 40 us and newton 2 of 400 us; to 1e-1 they take 32 and 3.
    assert describe_crossings(net(tmp_path, "sparse", "newton").curves) == [
        "at 3e-1 sparse is the fastest: 640 µs",
        "from 1e-1 on newton is faster than sparse: 1.2 ms against 1.28 ms",
    ]


def test_a_lead_changes_only_beyond_what_rounds_differ(tmp_path: Path) -> None:
    def describe_lead(folder: Path, factor: float) -> list[str]:
        a: list[dict[str, Any]] = list(made.build_curve_rows("net", 10, "early", "lbfgs"))
        b: list[dict[str, Any]] = [row | {"solver": "vbd"} for row in a]
        for row in b[1:]:  # slower at first, then faster by the factor
            row["seconds"] = [s * (2.0 if row["iteration"] < 20 else factor) for s in row["seconds"]]
        return describe_crossings(table(folder, [*made.build_snapshot_rows("net", 10, "early"), *a, *b]).curves)

    assert len(describe_lead(tmp_path / "noise", 0.97)) == 1, "3 % lie within quartiles of 0.985 and 1.05"
    changed = describe_lead(tmp_path / "sure", 0.5)
    assert len(changed) == 2
    assert "vbd is faster than lbfgs" in changed[1]


def test_what_the_first_guess_has_already_is_not_contested(tmp_path: Path) -> None:
    rows = [
        *made.build_snapshot_rows("net", 10, "early"),
        *made.build_curve_rows("net", 10, "early", "numba", initial_guess="inertial"),
    ]
    race = table(tmp_path, rows).curves
    assert not is_contested(race, 0.3), "the inertial target starts at 0.2"
    assert is_contested(race, 0.1)


def test_profiles_count_failures_as_never_and_omit_solvers_not_tried_everywhere(tmp_path: Path) -> None:
    rows = [*made.build_snapshot_rows("net", 10, "early"), *made.build_snapshot_rows("net", 20, "early")]
    for size in (10, 20):
        rows += made.build_curve_rows("net", size, "early", "numba")
        rows += made.build_curve_rows("net", size, "early", "sparse")
        rows.append(made.build_failure_row("net", size, "early", "newton", "diverged", "not finite"))
    rows += made.build_curve_rows("net", 10, "early", "lbfgs")  # not tried at 20
    found = table(tmp_path, rows)
    ratios = compute_performance_ratios(found, 1e-3)
    # 20 iterations at 1.2e-7 against 96 at 5e-8 and at 4e-7 s a vertex.
    assert "lbfgs" not in ratios
    assert describe_omitted_solvers(found) == ["Not shown, as not tried on every problem: lbfgs (on 1 of 2)."]
    assert ratios["numba"] == pytest.approx([96 * 5e-8 / (20 * 1.2e-7), 1.0])
    assert ratios["newton"].tolist() == [inf, inf]
    assert compute_cumulative_share(ratios["numba"], np.array([1.0, 2.1])).tolist() == [0.5, 1.0]
    assert compute_data_profile_ratios(found, 1e-3)["sparse"] == pytest.approx([96.0, 96.0]), "in its own iterations"


def test_growth_is_the_power_of_the_vertices(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = []
    for size in (8, 16, 32):
        rows += made.build_snapshot_rows("net", size, "early")
        rows += made.build_curve_rows("net", size, "early", "numba")
        if size < 32:
            rows += made.build_curve_rows("net", size, "early", "lbfgs")
    growth = {g.label: g for g in fit_scalings(table(tmp_path, rows))}
    assert growth["numba"].exponent == pytest.approx(1.0), "times were made in proportion to the vertices"
    assert isnan(growth["lbfgs"].exponent), "two sizes tell no power"


def test_the_front_contains_undominated_solvers_and_the_default_is_found(tmp_path: Path) -> None:
    works = table(tmp_path, list(made.build_work_rows("net", 10))).work_points
    best = find_pareto_front(works)
    assert [w.seconds_per_simulated_second for w in best] == sorted(w.seconds_per_simulated_second for w in best)
    assert [w.error for w in best] == sorted((w.error for w in best), reverse=True)
    assert not any(
        o.seconds_per_simulated_second < w.seconds_per_simulated_second and o.error < w.error
        for w in best
        for o in works
    )
    base = find_default_setting(works)
    assert base is not None
    assert (base.solver, base.integrator, base.residual_rtol, base.max_iterations) == (
        "numba",
        "implicit-euler",
        None,
        50,
    )
    assert base.time_step == pytest.approx(1 / 30)


def test_methods_that_do_not_minimise_carry_a_note(tmp_path: Path) -> None:
    minimises = {
        work.solver: work.is_minimiser for work in table(tmp_path, list(made.build_work_rows("net", 10))).work_points
    }
    assert minimises == {"numba": True, "hybrid": True, "xpbd": False}


@pytest.mark.parametrize("factor", [1.0, 1.5, 3.0])
def test_the_paper_s_figures_are_compared_point_by_point(tmp_path: Path, factor: float) -> None:
    found = compare_with_paper(table(tmp_path, made.build_liu2013_rows(factor)))
    assert len(found) == len(LIU2013_FIGURE_2) + sum(map(len, LIU2013_FIGURE_3.values()))
    # The rows of the step of figure 2 count among the frames of the largest curtain of figure 3.
    assert all(c.error_ratio == pytest.approx(factor) for c in found if "81" not in c.curve)


def test_the_paper_s_table_shows_every_curve_of_both_figures_with_its_ratios(tmp_path: Path) -> None:
    for factor in (1.0, 3.0):
        heading, rule, *rows = summarise_findings(table(tmp_path, made.build_liu2013_rows(factor)))["Liu et al. 2013"]
        assert heading.count("|") == rule.count("|")
        named = [row.split(" | ")[0].removeprefix("| ") for row in rows]
        assert named == ["figure 2", *(f"figure 3, {side} × {side}, k = {k}" for side, k in LIU2013_FIGURE_3)]
        for row, points in zip(rows, [LIU2013_FIGURE_2, *LIU2013_FIGURE_3.values()], strict=True):
            assert row.count(" = ") - row.count("k = ") == len(points), "a ratio for each point that the paper gives"
            if "81" not in row:  # whose frames the step of figure 2 counts among
                assert ("**3**" in row) == (factor > MAX_ERROR_RATIO), (
                    "what differs by more than a factor of 2 stands out"
                )


def test_the_paper_s_short_curves_are_not_mixed_with_the_others(tmp_path: Path) -> None:
    everything = table(tmp_path, made.build_liu2013_rows())
    saved = without_short_curves(everything)
    assert len(everything.problems) == 2 * len(LIU2013_FIGURE_3)
    assert [(p.vertices, p.snapshot) for p in saved.problems] == [(81 * 81, "frame-1")]
    assert saved.problems[0].objective_initial == made.LOWEST_ENERGY + 0.5 * made.ENERGY_DROP, (
        "at the inertial target, as in the paper"
    )


def test_the_summary_is_json_with_a_time_for_each_accuracy(tmp_path: Path) -> None:
    (entry,) = json.loads(json.dumps(build_curve_summary(net(tmp_path, "numba")), allow_nan=False))
    assert list(entry["time_to_gap"]) == [format_gap(target) for target in GAP_TARGETS]
    assert entry["time_to_gap"]["1e-3"]["iteration"] == 96
    assert entry["setup_seconds"] == pytest.approx(SETUP * 100)


def test_every_failure_is_reported_with_its_reason(tmp_path: Path) -> None:
    rows = [
        *made.build_snapshot_rows("net", 10, "early"),
        made.build_failure_row("net", 10, "early", "dense", "unsupported", "supports springs"),
    ]
    work = next(made.build_work_rows("net", 10)) | {"status": "time-limit", "reason": "5 s", "error": None}
    found = list_failures(table(tmp_path, [*rows, work]))
    assert [(row["status"], row["reason"]) for row in found] == [
        ("unsupported", "supports springs"),
        ("time-limit", "5 s"),
    ]


def test_a_folder_without_rows_is_a_mistake_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="springbench accuracy"):
        read_accuracy(tmp_path)
    (tmp_path / "accuracy").mkdir()
    (tmp_path / "accuracy" / "broken.parquet").write_bytes(b"no rows")
    with pytest.raises(InputError, match=r"broken\.parquet"):
        read_accuracy(tmp_path)


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.0412, "41.2 ms"), (1.3, "1.3 s"), (2.5e-5, "25 µs"), (0.9999, "1 s"), (0.0, "0 µs")]
)
def test_times_are_printed_in_the_unit_that_fits(seconds: float, words: str) -> None:
    assert format_duration(seconds) == words
