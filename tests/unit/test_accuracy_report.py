"""What the accuracy report computes from rows whose answers are known."""

from __future__ import annotations

import json
from collections.abc import Sequence
from math import inf, isnan
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.base.errors import InputError
from harness.report.accuracy.findings import failures, findings, summary
from harness.report.accuracy.growth import growths
from harness.report.accuracy.measured import Curve, Measurements, without_short
from harness.report.accuracy.paper import FAR, FIGURE_2, FIGURE_3, comparisons
from harness.report.accuracy.profiles import iteration_ratios, least_ratios, not_shown, share
from harness.report.accuracy.reading import read
from harness.report.accuracy.times import TARGETS, contested, crossings, duration, power, reach, seconds_to
from harness.report.accuracy.work_plot import default, front
from tests import accuracy_rows as made

COST, SETUP = made.METHODS["numba"]["cost"], made.METHODS["numba"]["setup"]


def table(folder: Path, rows: Sequence[dict[str, Any]]) -> Measurements:
    return read(made.write(folder, rows))


def net(folder: Path, *solvers: str, size: int = 10, **more: Any) -> Measurements:
    """One step of a net."""
    problem = made.problem("net", size, "early", **more)
    return table(folder, [*problem, *(row for s in solvers for row in made.curve("net", size, "early", s))])


def by_solver(found: Measurements) -> dict[str, Curve]:
    return {curve.solver: curve for curve in found.curves}


def test_gaps_are_relative_to_the_best_minimum_and_the_current_positions(tmp_path: Path) -> None:
    curve = by_solver(net(tmp_path, "numba"))["numba"]
    expected = made.gaps(0.93, curve.iterations.astype(int).tolist(), 1.0)
    # The energies are of order 1 J and rounded to 1e-16 of that, the gaps to 2e-16 of their scale.
    np.testing.assert_allclose(curve.gap, expected, rtol=1e-9, atol=1e-15)
    assert curve.problem.round_off == pytest.approx(40.0 * np.finfo(float).eps / made.DROP)
    assert curve.largest[0] == pytest.approx(0.3 * 10), "0.3 m in mean rest lengths of 1/10 m"


def test_a_lower_minimum_mends_all_gaps_without_a_new_run(tmp_path: Path) -> None:
    rows = list(made.curve("net", 10, "early", "numba"))
    before = table(tmp_path / "a", [*made.problem("net", 10, "early"), *rows])
    lower = made.problem("net", 10, "early")[1] | {"g": made.G - 0.5, "minimum": "deeper"}
    after = table(tmp_path / "b", [*made.problem("net", 10, "early"), lower, *rows])
    assert before.curves[0].branch == 0
    assert after.curves[0].branch == 1, "the minimum that the rows called the lowest is the second now"
    # In the limit the old minimum is 0.5 J above the new one, of 2.5 J from the start.
    assert after.curves[0].gap[-1] == pytest.approx(0.5 / 2.5)


@pytest.mark.parametrize("target", TARGETS)
def test_an_accuracy_is_reached_at_the_first_whole_iteration_at_or_below_it(tmp_path: Path, target: float) -> None:
    reached = reach(by_solver(net(tmp_path, "numba"))["numba"], target)
    assert reached is not None
    exact = int(np.ceil(np.log(target) / np.log(0.93)))  # the gap falls by 0.93 an iteration, between kept ones too
    assert reached.iteration == exact
    assert reached.seconds == pytest.approx(COST * 100 * exact)
    # Rounds of 0.97, 1 and 1.1 times that: their quartiles.
    assert reached.lower == pytest.approx(0.985 * reached.seconds)
    assert reached.upper == pytest.approx(1.05 * reached.seconds)


def test_set_up_is_spread_over_the_steps(tmp_path: Path) -> None:
    curve = by_solver(net(tmp_path, "numba"))["numba"]
    alone = seconds_to(curve, 1e-3)
    assert [seconds_to(curve, 1e-3, n) - alone for n in (1, 10, 100)] == pytest.approx(
        [SETUP * 100, SETUP * 10, SETUP], rel=1e-6
    )


@pytest.mark.parametrize(
    ("status", "seconds"),
    [("diverged", inf), ("failed", inf), ("unsupported", inf), ("time-limit", 4.8e-4), ("no-progress", 4.8e-4)],
)
def test_failures_reach_nothing_and_limits_keep_what_came_before(tmp_path: Path, status: str, seconds: float) -> None:
    rows = [row | {"status": status} for row in made.curve("net", 10, "early", "numba") if row["kind"] == "curve"]
    curve = table(tmp_path, [*made.problem("net", 10, "early"), *rows]).curves[0]
    assert seconds_to(curve, 1e-3) == pytest.approx(seconds)  # 96 iterations of 5e-8 s a vertex
    assert isnan(curve.warm)


def test_a_solver_in_another_minimum_never_reaches_the_gaps_below_it(tmp_path: Path) -> None:
    rows = [*made.problem("net", 10, "early", branches=2), *made.curve("net", 10, "early", "newton", branch=1)]
    curve = table(tmp_path, rows).curves[0]
    assert curve.branch == 1
    assert reach(curve, 1e-1) is not None, "its minimum is 0.05 of the scale above the lowest"
    assert reach(curve, 1e-2) is None


@pytest.mark.parametrize(
    ("change", "doubt"),
    [
        pytest.param({"certified": False}, "not certified", id="not certified"),
        pytest.param({"g": None}, "no minimum is known", id="none known"),
        pytest.param({"g": made.G + 0.3}, "went below", id="a solver went below"),
        pytest.param({}, "", id="certified"),
    ],
)
def test_a_reference_that_is_not_certified_says_so_and_is_not_used(tmp_path: Path, change: dict, doubt: str) -> None:
    problem, minimum = made.problem("net", 10, "early")
    found = table(tmp_path, [problem, minimum | change, *made.curve("net", 10, "early", "numba")])
    assert (doubt in found.problems[0].doubt) if doubt else not found.problems[0].doubt
    assert len(least_ratios(found, 1e-2)["numba"]) == (0 if doubt else 1), "profiles take certified steps alone"
    assert np.nanmin(found.curves[0].gap) < 1e-9, "the gaps shown refer to the lowest energy that is known"
    assert ("References that are not certified" in findings(found)) == bool(doubt)


def test_crossings_name_who_overtakes_whom_and_both_times(tmp_path: Path) -> None:
    # To 3e-1 sparse takes 16 iterations of 40 us and newton 2 of 400 us; to 1e-1 they take 32 and 3.
    assert crossings(net(tmp_path, "sparse", "newton").curves) == [
        "at 3e-1 sparse is the fastest: 640 µs",
        "from 1e-1 on newton is faster than sparse: 1.2 ms against 1.28 ms",
    ]


def test_a_lead_changes_only_beyond_what_rounds_differ(tmp_path: Path) -> None:
    def race(folder: Path, factor: float) -> list[str]:
        a: list[dict[str, Any]] = list(made.curve("net", 10, "early", "lbfgs"))
        b: list[dict[str, Any]] = [row | {"solver": "vbd"} for row in a]
        for row in b[1:]:  # slower at first, then faster by the factor
            row["seconds"] = [s * (2.0 if row["iteration"] < 20 else factor) for s in row["seconds"]]
        return crossings(table(folder, [*made.problem("net", 10, "early"), *a, *b]).curves)

    assert len(race(tmp_path / "noise", 0.97)) == 1, "3 % lie within quartiles of 0.985 and 1.05"
    changed = race(tmp_path / "sure", 0.5)
    assert len(changed) == 2
    assert "vbd is faster than lbfgs" in changed[1]


def test_what_the_first_guess_has_already_is_not_contested(tmp_path: Path) -> None:
    rows = [*made.problem("net", 10, "early"), *made.curve("net", 10, "early", "numba", guess="inertial")]
    race = table(tmp_path, rows).curves
    assert not contested(race, 0.3), "the inertial target starts at 0.2"
    assert contested(race, 0.1)


def test_profiles_count_failures_as_never_and_leave_out_who_was_not_tried_everywhere(tmp_path: Path) -> None:
    rows = [*made.problem("net", 10, "early"), *made.problem("net", 20, "early")]
    for size in (10, 20):
        rows += made.curve("net", size, "early", "numba")
        rows += made.curve("net", size, "early", "sparse")
        rows.append(made.failure("net", size, "early", "newton", "diverged", "not finite"))
    rows += made.curve("net", 10, "early", "lbfgs")  # not tried at 20
    found = table(tmp_path, rows)
    ratios = least_ratios(found, 1e-3)
    # 20 iterations at 1.2e-7 against 96 at 5e-8 and at 4e-7 s a vertex.
    assert "lbfgs" not in ratios
    assert not_shown(found) == ["Not shown, as not tried on every problem: lbfgs (on 1 of 2)."]
    assert ratios["numba"] == pytest.approx([96 * 5e-8 / (20 * 1.2e-7), 1.0])
    assert ratios["newton"].tolist() == [inf, inf]
    assert share(ratios["numba"], np.array([1.0, 2.1])).tolist() == [0.5, 1.0]
    assert iteration_ratios(found, 1e-3)["sparse"] == pytest.approx([96.0, 96.0]), "in its own iterations"


def test_growth_is_the_power_of_the_vertices(tmp_path: Path) -> None:
    rows: list[dict[str, Any]] = []
    for size in (8, 16, 32):
        rows += made.problem("net", size, "early")
        rows += made.curve("net", size, "early", "numba")
        if size < 32:
            rows += made.curve("net", size, "early", "lbfgs")
    growth = {g.label: g for g in growths(table(tmp_path, rows))}
    assert growth["numba"].exponent == pytest.approx(1.0), "times were made in proportion to the vertices"
    assert isnan(growth["lbfgs"].exponent), "two sizes tell no power"


def test_the_front_holds_what_nothing_beats_and_the_default_is_found(tmp_path: Path) -> None:
    works = table(tmp_path, list(made.work("net", 10))).works
    best = front(works)
    assert [w.seconds for w in best] == sorted(w.seconds for w in best)
    assert [w.error for w in best] == sorted((w.error for w in best), reverse=True)
    assert not any(o.seconds < w.seconds and o.error < w.error for w in best for o in works)
    base = default(works)
    assert base is not None
    assert (base.solver, base.integrator, base.tolerance, base.iterations) == ("numba", "implicit-euler", None, 50)
    assert base.time_step == pytest.approx(1 / 30)


def test_methods_that_do_not_minimise_carry_a_note(tmp_path: Path) -> None:
    minimises = {work.solver: work.minimises for work in table(tmp_path, list(made.work("net", 10))).works}
    assert minimises == {"numba": True, "hybrid": True, "xpbd": False}


@pytest.mark.parametrize("factor", [1.0, 1.5, 3.0])
def test_the_paper_s_figures_are_compared_point_by_point(tmp_path: Path, factor: float) -> None:
    found = comparisons(table(tmp_path, made.paper(factor)))
    assert len(found) == len(FIGURE_2) + sum(map(len, FIGURE_3.values()))
    # The rows of the step of figure 2 count among the frames of the largest curtain of figure 3.
    assert all(c.ratio == pytest.approx(factor) for c in found if "81" not in c.curve)


def test_the_paper_s_table_shows_every_curve_of_both_figures_with_its_ratios(tmp_path: Path) -> None:
    for factor in (1.0, 3.0):
        heading, rule, *rows = findings(table(tmp_path, made.paper(factor)))["Liu et al. 2013"]
        assert heading.count("|") == rule.count("|")
        named = [row.split(" | ")[0].removeprefix("| ") for row in rows]
        assert named == ["figure 2", *(f"figure 3, {side} × {side}, k = {k}" for side, k in FIGURE_3)]
        for row, points in zip(rows, [FIGURE_2, *FIGURE_3.values()], strict=True):
            assert row.count(" = ") - row.count("k = ") == len(points), "a ratio for each point that the paper gives"
            if "81" not in row:  # whose frames the step of figure 2 counts among
                assert ("**3**" in row) == (factor > FAR), "what differs by more than a factor of 2 stands out"


def test_the_paper_s_short_curves_are_not_mixed_with_the_others(tmp_path: Path) -> None:
    everything = table(tmp_path, made.paper())
    kept = without_short(everything)
    assert len(everything.problems) == 2 * len(FIGURE_3)
    assert [(p.vertices, p.moment) for p in kept.problems] == [(81 * 81, "frame-1")]
    assert kept.problems[0].g0 == made.G + 0.5 * made.DROP, "at the inertial target, as in the paper"


def test_the_summary_is_json_with_a_time_for_each_accuracy(tmp_path: Path) -> None:
    (entry,) = json.loads(json.dumps(summary(net(tmp_path, "numba")), allow_nan=False))
    assert list(entry["to_gap"]) == [power(target) for target in TARGETS]
    assert entry["to_gap"]["1e-3"]["iterations"] == 96
    assert entry["set_up_seconds"] == pytest.approx(SETUP * 100)


def test_every_failure_is_told_with_its_reason(tmp_path: Path) -> None:
    rows = [
        *made.problem("net", 10, "early"),
        made.failure("net", 10, "early", "dense", "unsupported", "knows springs"),
    ]
    work = next(made.work("net", 10)) | {"status": "time-limit", "reason": "5 s", "error": None}
    found = failures(table(tmp_path, [*rows, work]))
    assert [(row["status"], row["reason"]) for row in found] == [
        ("unsupported", "knows springs"),
        ("time-limit", "5 s"),
    ]


def test_a_folder_without_rows_is_a_mistake_that_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="springbench accuracy"):
        read(tmp_path)
    (tmp_path / "accuracy").mkdir()
    (tmp_path / "accuracy" / "broken.parquet").write_bytes(b"no rows")
    with pytest.raises(InputError, match=r"broken\.parquet"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.0412, "41.2 ms"), (1.3, "1.3 s"), (2.5e-5, "25 µs"), (0.9999, "1 s"), (0.0, "0 µs")]
)
def test_times_are_told_in_the_unit_that_fits(seconds: float, words: str) -> None:
    assert duration(seconds) == words
