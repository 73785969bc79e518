"""Recommendations: the cheapest method for an error, from what was measured, checked by one more simulation."""

from __future__ import annotations

import shlex
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from time import sleep
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from springbench.harness.cli.commands.recommend import parse_duration
from springbench.harness.cli.main import main
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.config.shipped_configs import locate_config
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.experiments.accuracy import candidate_grids, work_precision
from springbench.harness.experiments.accuracy import method_recommendation as module
from springbench.harness.experiments.accuracy.accuracy_schema import ACCURACY_SCHEMA
from springbench.harness.experiments.accuracy.accuracy_units import load_reference_trajectory, open_reference_store
from springbench.harness.experiments.accuracy.candidate_grids import StudyCandidates
from springbench.harness.experiments.accuracy.method_recommendation import (
    MethodRecommendation,
    RecommendationOptions,
    recommend_method,
)
from springbench.harness.experiments.accuracy.recommendation_goal import MeasuredMethod, RecommendationGoal
from springbench.harness.experiments.accuracy.setting_grid import compute_setting_cost
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.results import parquet_rows
from springbench.harness.results.folder_ownership import claim_folder
from springbench.harness.schema.yaml_loader import parse_scalar

from tests.progress_displays import SilentDisplay

SCENE = """
mesh: {kind: chain, length: 2.0}
mass: 1.0
time_step: 1/30
frames: 8
default_size: 4
effects: [{kind: springs, stretch: 200}, {kind: gravity}, {kind: pins, parts: [ends]}]
"""
REFINEMENTS = (1, 4)
METHODS = [
    {"solver": ["sparse"], "rtol": 1e-3, "max_iterations": 200, "integrator": ["implicit-euler", "midpoint"]},
    {"solver": ["sparse"], "max_iterations": 5},
]
COUNT = len(REFINEMENTS) * 3


pytestmark = pytest.mark.usefixtures("without_workers")


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid of six simulations."""
    monkeypatch.setattr(candidate_grids, "build_candidate_grid", lambda: METHODS)
    monkeypatch.setattr(candidate_grids, "TIME_STEP_REFINEMENTS", REFINEMENTS)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "chain.yaml").write_text(SCENE)
    return tmp_path / "chain.yaml"


def recommend(scene: Path, error: float, **more: Any) -> tuple[MethodRecommendation, int]:
    """The answer, and how many simulations were measured for it."""
    display, results = SilentDisplay(), scene.parent / "results"
    given: dict[str, Any] = {"size": None, "t_end": 0.2, "time_limit": 60.0} | more
    print_message = given.pop("print_message", lambda line: None)
    goal = given.pop("goal", RecommendationGoal(max_error=error))
    found = recommend_method(scene, goal, RecommendationOptions(**given), results, display, print_message)
    return found, display.finished_units


def row_cost(row: dict[str, Any]) -> float:
    """Seconds per simulated second, by the processor where others had it too."""
    return row["cpu_seconds"] / row["t_end"] if row["preempted"] else row["seconds_per_simulated_second"]


def list_work_files(scene: Path) -> list[Path]:
    return sorted((scene.parent / "results").glob("*/accuracy/*-work-*.parquet"))


def test_the_cheapest_method_within_the_error_is_recommended_and_verified(scene: Path) -> None:
    said = list[str]()
    found, count = recommend(scene, 0.1, print_message=said.append)
    assert count == len(list_work_files(scene)) <= COUNT
    assert any(line.startswith(f"chain 4: {count} of {COUNT} settings measured") for line in said)
    table = parquet_rows.read_rows(list_work_files(scene), ACCURACY_SCHEMA).to_pylist()
    within = [row for row in table if row["error"] <= 0.1]
    assert 0 < len(within) < len(table), "the error separates nothing"
    cheapest = min(within, key=row_cost)
    assert (found.best_method.error, found.best_method.seconds_per_simulated_second) == (
        cheapest["error"],
        row_cost(cheapest),
    )
    assert found.best_method.work_spec.case.scene.time_step == cheapest["time_step"]
    assert found.checked_method.error == found.best_method.error  # the same simulation gives the same positions
    assert found.checked_method.seconds_per_simulated_second > 0.0
    command = found.best_method.format_command(locate_config("net"))
    assert command.startswith("springbench run net "), "the name of a shipped scene, not its path"
    slower = replace(
        found,
        checked_method=replace(
            found.best_method, seconds_per_simulated_second=2.0 * found.best_method.seconds_per_simulated_second
        ),
    )
    other = replace(found, checked_method=replace(found.best_method, error=2.0 * found.best_method.error))
    assert replace(found, checked_method=found.best_method).verdict.startswith("as predicted")
    assert "the time 2 times that" in slower.verdict
    assert other.verdict.startswith("not as predicted")


def test_stored_measurements_are_not_repeated(scene: Path) -> None:
    first, _ = recommend(scene, 0.1)
    again, count = recommend(scene, 0.1)
    assert count == 0
    assert again.best_method == first.best_method


@pytest.mark.long
def test_measurements_of_another_scene_or_machine_are_not_reused(scene: Path) -> None:
    recommend(scene, 0.1)
    scene.write_text(SCENE.replace("200", "210"))
    assert recommend(scene, 0.1)[1] > 0
    for path in list_work_files(scene):
        table = pq.read_table(path)
        for column, value in (("machine_id", "0" * 12), ("unit_id", "measured there")):
            k = table.schema.get_field_index(column)
            table = table.set_column(k, column, pa.array([value] * len(table)))
        pq.write_table(table, path)
    assert recommend(scene, 0.1)[1] > 0
    assert recommend(scene, 0.1, t_end=0.4)[1] > 0


def test_the_results_of_another_scene_of_this_name_are_left_alone(scene: Path) -> None:
    (scene.parent / "other").mkdir()
    other = scene.parent / "other" / scene.name
    other.write_text(SCENE)
    claim_folder(scene.parent / "results" / f"recommend-{scene.stem}", other)
    with pytest.raises(InputError, match="contains the results of another file of this name"):
        recommend(scene, 0.1)
    assert not list_work_files(scene)


def test_an_error_that_no_method_reaches_is_reported_with_the_nearest(scene: Path) -> None:
    with pytest.raises(RunFailed, match=r"nothing that was measured reaches an error of 1e-08 .* midpoint") as raised:
        recommend(scene, 1e-8)
    assert "use a larger --error or a shorter --t-end" in str(raised.value)


def test_an_exhausted_search_time_is_stated_and_the_search_resumes_from_there(scene: Path) -> None:
    with pytest.raises(RunFailed, match=rf"settings remain \(0 of {COUNT} settings measured; 6 not: the time"):
        recommend(scene, 0.1, search_time=1e-9)
    found, count = recommend(scene, 0.1)
    assert count > 0
    assert found.best_method.error <= 0.1


@pytest.mark.parametrize("option", ["error", "t_end", "time_limit", "search_time"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_a_value_that_is_not_positive_is_a_mistake(scene: Path, option: str, value: float) -> None:
    with pytest.raises(InputError, match="expected a number above 0"):
        recommend(scene, **{"error": 0.1, option: value})


def test_a_mesh_has_to_have_a_size(scene: Path) -> None:
    scene.write_text(SCENE.replace("default_size: 4", ""))
    with pytest.raises(InputError, match=r"^--size: is missing; the scene chain needs a mesh size"):
        recommend(scene, 0.1)
    with pytest.raises(InputError, match=r"^--size: got 1; should be greater than or equal to 2$"):
        recommend(scene, 0.1, size=1)


def test_the_command_shows_what_it_predicts_and_what_it_measured(
    scene: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    results = str(scene.parent / "results")
    options = ["--error", "0.1", "--t-end", "0.2", "--results", results]
    monkeypatch.setattr("sys.argv", ["springbench", "recommend", str(scene), *options])
    with pytest.raises(SystemExit) as ended:
        main()
    captured = capsys.readouterr()
    assert not ended.value.code, captured.err
    assert all(word in captured.out for word in ("predicted", "measured", "sparse", "time step"))
    assert list((scene.parent / "results" / "recommend-chain" / "pictures").glob("methods-chain-4-0_1-0_2.png"))
    said = (captured.out + captured.err).splitlines()
    command = next(line for line in said if line.startswith("  springbench run "))
    _, _, config, *given = shlex.split(command)
    options = {
        name[2:].replace("-", "_"): parse_scalar(value) for name, value in zip(given[::2], given[1::2], strict=True)
    }
    (run,) = load_config(
        Path(config), solvers=[options.pop("solver")], sizes=[options.pop("size")], **options
    ).list_runs()
    assert run.solver.name == "sparse"
    assert run.frames * run.scene.time_step == pytest.approx(0.2)


def test_a_scene_without_a_reference_is_refused_before_anything_is_measured(scene: Path) -> None:
    scene.write_text(SCENE.replace("{kind: gravity}", "{kind: contact, obstacles: [{kind: plane, point: [0, -9, 0]}]}"))
    said = list[str]()
    with pytest.raises(RunFailed, match="nothing moves"):
        recommend(scene, 0.1, print_message=said.append)
    assert any(line.startswith("chain: contact has") for line in said)
    assert sum("no certified reference" in line for line in said) == 1
    assert not list_work_files(scene)


def test_compiling_counts_against_no_time_limit(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = module.build_study(
        scene, load_scene(scene), 4, StudyCandidates.from_goal(RecommendationGoal(max_error=0.1), None), 0.2, 60.0
    ).work[0]
    first, slow = [True], work_precision.simulate_scene

    def simulate(*given: Any, **more: Any) -> Any:
        for step in slow(*given, **more):
            if first.pop() if first else False:
                sleep(0.3)
            yield step

    monkeypatch.setattr(work_precision, "simulate_scene", simulate)
    limited = replace(spec, measurement=replace(spec.measurement, time_limit=0.25))
    row = work_precision.build_work_rows(
        limited, load_reference_trajectory(limited, open_reference_store(scene.parent / "results")), lambda: None
    )[0]
    assert row["status"] == "ok", row
    assert not first


def test_steps_that_a_solver_takes_within_a_frame_are_printed() -> None:
    path = Path(__file__).parents[2] / "configs" / "scenes" / "chain.yaml"
    spec = module.build_study(
        path, load_scene(path), 4, StudyCandidates.from_goal(RecommendationGoal(max_error=0.1), None), 0.2, 60.0
    ).work[0]
    spec = replace(spec, solver=SolverSpec("velocity-verlet", {}))
    way = MeasuredMethod(spec, 1e-3, 1.0, "integrated", "1140 substeps of 2.9e-05 s")
    assert str(way).startswith(f"solver {spec.solver.name}, 1140 substeps of 2.9e-05 s, in each frame of ")
    assert "time step" not in str(way)


def test_without_a_horizon_it_is_the_longest_at_which_the_error_can_be_measured(tmp_path: Path) -> None:
    path = Path(__file__).parents[2] / "configs" / "scenes" / "hanging-cloth.yaml"
    spec, said = load_scene(path), list[str]()
    longest = module.find_default_t_end(path, spec, 12, 1e-7, ReferenceStore(tmp_path), said.append)
    assert 0.5 < longest < module.DEFAULT_T_END
    assert f"up to {longest:g} s" in said[0]
    assert (
        module.find_default_t_end(path, spec, 12, 1e-2, ReferenceStore(tmp_path), said.append) == module.DEFAULT_T_END
    )
    with pytest.raises(RunFailed, match="cannot be reached or measured"):
        module.find_default_t_end(path, spec, 12, 1e-14, ReferenceStore(tmp_path), said.append)


def test_a_budget_gets_the_least_error_within_it_and_what_half_and_twice_would_buy(scene: Path) -> None:
    """With a budget that nothing exceeds, the most accurate setting wins; the others follow from the same rows."""
    found, count = recommend(scene, 0.0, goal=RecommendationGoal(frame_seconds=1.0))
    assert count == len(list_work_files(scene))
    least = min(found.measured_methods, key=lambda method: method.error)
    assert found.best_method == least
    assert found.checked_method.error == least.error
    runner_up = found.find_runner_up()
    assert runner_up is not None
    assert runner_up.work_spec.case.integrator != least.work_spec.case.integrator
    costs = sorted(method.seconds_per_simulated_second for method in found.measured_methods)
    tight = replace(found, goal=RecommendationGoal(frame_seconds=found.frame * costs[2]))
    for factor in (0.5, 1.0, 2.0):
        within = [one for one in found.measured_methods if one.seconds_per_simulated_second <= factor * costs[2]]
        assert tight.select_best(factor) == min(within, key=lambda method: method.error, default=None)


def test_step_sizes_between_powers_of_two_use_up_a_budget(scene: Path) -> None:
    """Of the methods within the budget, by as many steps as fit; those beyond it and those that fill it are left."""
    spec = recommend(scene, 0.5)[0].best_method.work_spec
    steps = round(spec.t_end / spec.case.scene.time_step)

    def count_frames(cost: float) -> list[int]:
        method = MeasuredMethod(spec, 0.1, cost, "integrated", "")
        found = module.list_tuned_specs([method], 1.0, spec.t_end)
        return [round(one.t_end / one.case.scene.time_step) for one in found]

    assert count_frames(0.3) == [int(0.95 / 0.3 * steps)]
    assert count_frames(1e-6) == [8 * steps]
    assert count_frames(0.95) == count_frames(1.1) == []


def test_the_time_of_a_busy_machine_is_its_processor_time(scene: Path) -> None:
    spec = replace(recommend(scene, 0.5)[0].best_method.work_spec, t_end=0.5)
    row = {"seconds_per_simulated_second": 4.0, "cpu_seconds": 1.0, "preempted": True}
    assert compute_setting_cost(spec, row) == 2.0
    assert compute_setting_cost(spec, row | {"preempted": False}) == 4.0
    assert compute_setting_cost(replace(spec, solver=SolverSpec("mujoco", {})), row) == 4.0


@pytest.mark.long
def test_a_budget_that_nothing_meets_names_the_cheapest(scene: Path) -> None:
    with pytest.raises(RunFailed, match=r"takes at most 1e-06 ms for a frame of 0.0333333 s; the cheapest is"):
        recommend(scene, 0.0, goal=RecommendationGoal(frame_seconds=1e-9))


@pytest.mark.long
def test_the_search_can_be_of_one_solver(scene: Path) -> None:
    found, _ = recommend(scene, 0.5, engine="numba")
    assert {method.work_spec.solver.name for method in found.measured_methods} == {"numba"}
    with pytest.raises(InputError, match=r"--engine: got 'mujocko'; expected .*mujoco"):
        recommend(scene, 0.5, engine="mujocko")


@pytest.mark.long
@pytest.mark.skipif(find_spec("mujoco") is None, reason="MuJoCo is not installed: pip install 'springbench[mujoco]'")
def test_an_engine_is_searched_over_its_substeps(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(candidate_grids, "ENGINE_SUBSTEPS", [16])
    found, _ = recommend(scene, 0.0, goal=RecommendationGoal(frame_seconds=0.02), engine="mujoco")
    assert {method.work_spec.solver.parameters["mujoco_integrator"] for method in found.measured_methods} >= {"RK4"}
    assert "substeps a frame of 0.0333333 s" in str(found.best_method)


@pytest.mark.parametrize(("text", "seconds"), [("4ms", 4e-3), ("250us", 250e-6), ("0.1s", 0.1)])
def test_a_budget_has_a_unit(text: str, seconds: float) -> None:
    assert parse_duration(text, "--budget") == pytest.approx(seconds)


@pytest.mark.parametrize("text", ["4", "ms", "-1ms", "0s", "nan s", "infs", "4 min"])
def test_a_budget_without_a_unit_is_a_mistake(text: str) -> None:
    with pytest.raises(InputError, match=r"--budget: got .*; expected a number above 0 with its unit"):
        parse_duration(text, "--budget")
