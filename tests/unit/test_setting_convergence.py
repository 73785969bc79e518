"""Is a setting converged: the map around it, the verdict in words, and how stiff the material seems."""

from __future__ import annotations

import csv
from dataclasses import replace
from importlib.util import find_spec
from math import inf
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from springbench.harness.cli.commands.convergence import read_solver_options
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_scene
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.experiments import setting_convergence
from springbench.harness.experiments.accuracy.accuracy_units import open_reference_store
from springbench.harness.experiments.setting_convergence import (
    SampledReference,
    SettingSimulator,
    StudyLimits,
    measure_change,
    study_convergence,
)
from springbench.harness.reference import self_converged_trajectory
from springbench.harness.reference.equations_of_motion import NotIntegrable
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.report.charts.setting_chart import build_setting_chart
from springbench.harness.report.figures.chart_sheets import draw_chart_sheets
from springbench.harness.results.setting_verdict import (
    ConvergenceStudy,
    SettingAssessment,
    SettingChange,
    SettingDifference,
    SettingResult,
    StepSetting,
    find_doubled,
    list_settings,
    parse_setting,
)
from springbench.harness.scenes.scene_builder import build_scene
from typer.testing import CliRunner

SCENE = """
mesh: {kind: chain, length: 2.0}
mass: 1.0
time_step: 1/30
frames: 8
default_size: 6
effects: [{kind: springs, stretch: 200}, {kind: gravity}, {kind: pins, parts: [ends]}]
"""
GIVEN_SETTING = StepSetting(2, 4)
END = 0.2


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "chain.yaml").write_text(SCENE)
    return tmp_path / "chain.yaml"


def simulate(scene: Path, solver: str, **parameters: Any) -> SettingSimulator:
    return SettingSimulator(load_scene(scene), 6, SolverSpec(solver, parameters), None, END)


def study(
    scene: Path, solver: str = "sparse", given: StepSetting = GIVEN_SETTING, error: float = 0.05
) -> ConvergenceStudy:
    return study_simulator(simulate(scene, solver), scene, [given], error)


def study_simulator(simulator: SettingSimulator, scene: Path, given: list[StepSetting], error: float, **limits: Any):
    store, how = open_reference_store(scene.parent / "results"), StudyLimits(60.0, 60.0, **limits)
    return study_convergence(
        simulator, given, store, error, num_doublings=1, limits=how, print_message=lambda line: None
    )


def synthetic(errors: dict[tuple[int, int], float], **how: Any) -> ConvergenceStudy:
    results = tuple(
        SettingResult(StepSetting(*setting), error, 0.1, -0.02, 1e-3 * setting[0] * max(1, setting[1]))
        for setting, error in errors.items()
    )
    changes = SettingChange(2.0, how.pop("substeps", 0.2)), SettingChange(2.0, how.pop("iterations", 0.03))
    given = how.pop("given", [GIVEN_SETTING])
    assessments = tuple(SettingAssessment(one, *changes, 0.5) for one in given)
    return ConvergenceStudy("sparse", 0.05, "the integrated motion", results, assessments, **how)


MAP = {(1, 4): 0.4, (2, 2): 0.5, (2, 4): 0.2, (2, 8): 0.1, (4, 4): 0.04, (4, 8): 0.03, (8, 8): 0.009}


def test_settings_are_powers_of_two_around_the_given_one():
    found = list_settings([StepSetting(2, 5)], 2)
    assert {setting.substeps for setting in found} == {1, 2, 4, 8}
    assert {setting.iterations for setting in found} == {1, 2, 5, 10, 20}
    assert len(found) == len(set(found)) == 20
    assert list_settings([StepSetting(4, 0)], 1) == [(2, 0), (4, 0), (8, 0)]


def test_several_settings_share_a_map_of_all_their_numbers():
    found = list_settings([StepSetting(2, 5), StepSetting(6, 10)], 1)
    assert {setting.substeps for setting in found} == {1, 2, 6, 12}
    assert {setting.iterations for setting in found} == {2, 5, 10, 20}
    assert find_doubled(found, StepSetting(2, 5), "substeps") == (6, 5), "the next that is at least twice"
    assert find_doubled(found, StepSetting(2, 5), "iterations") == (2, 10)
    assert find_doubled(found, StepSetting(12, 5), "substeps") is None
    assert find_doubled(list_settings([StepSetting(4, 0)], 1), StepSetting(4, 0), "iterations") is None


def test_a_setting_is_read_from_two_numbers_or_one():
    assert [parse_setting(text) for text in ("2x5", "10 X 15", "8")] == [(2, 5), (10, 15), (8, 0)]
    for text in ("", "x", "2x", "0x5", "2x0", "2x5x3", "1.5", "1000001", "1x1000001"):
        with pytest.raises(ValueError):
            parse_setting(text)


def test_the_verdict_names_what_is_wrong_and_the_cheapest_setting_for_each_error():
    lines = synthetic(MAP).describe_verdict()
    assert lines[0].startswith("2 x 4 substeps x iterations: not converged to 5 %. The error is 20 %, against the")
    assert (
        "largest strain is 10 %; its energy at the end is 2 % of the largest kinetic energy less than true" in lines[1]
    )
    assert lines[2] == "Twice the substeps change the motion by 20 %, which is more than the required error."
    assert lines[3] == "Twice the iterations change the motion by 3 %, less than the required error."
    assert "as if it were 0.5 times as stiff" in lines[4]
    assert lines[5] == "Within 5 %: 4 x 4 is the cheapest, 16 ms a frame, 2 times the given."
    assert lines[6] == "Within 1 %: 8 x 8 is the cheapest, 64 ms a frame, 8 times the given."


def test_the_verdict_on_several_settings_has_a_line_for_each_and_what_the_nearest_lacks():
    given = [GIVEN_SETTING, StepSetting(4, 8)]
    drawn = synthetic(MAP, given=given, largest_difference=SettingDifference(given[0], given[1], 0.17))
    lines = drawn.describe_verdict()
    assert lines[0].startswith("None of the 2 settings is converged to 5 %. 4 x 8 is the nearest to the integrated")
    assert lines[1] == "2 x 4: error 20 %, largest strain 10 %, hangs as if 0.5 times as stiff."
    assert (
        lines[3]
        == "The motions of 2 x 4 and 4 x 8 differ by 17 %: what is found with one need not be valid with the other."
    )
    assert lines[4] == "4 x 8: twice the substeps change the motion by 20 %, which is more than the required error."
    assert lines[6] == "Within 5 %: 4 x 4 is the cheapest, 16 ms a frame."
    assert not drawn.is_converged
    good = synthetic(MAP, given=[StepSetting(4, 8), StepSetting(8, 8)], substeps=0.01)
    assert good.describe_verdict()[0].startswith("2 of the 2 settings are converged to 5 %. 8 x 8 is the nearest")


@pytest.mark.parametrize(
    ("falls", "predicted"),
    [(lambda s, i: 0.2 / s, (8, 4)), (lambda s, i: 0.2 / i, (2, 16)), (lambda s, i: 0.1 * s**-0.01, None)],
)
def test_beyond_the_map_a_setting_is_predicted_by_the_trend(falls: Any, predicted: StepSetting | None):
    drawn = synthetic({(s, i): falls(s, i) for s in (1, 2) for i in (2, 4)})
    nearest = min(result.error for result in drawn.results)
    assert drawn.predict_setting(nearest / 3.0) == predicted
    line = drawn.describe_verdict()[-1]
    assert ("By the trend about" in line) is (drawn.predict_setting(0.01) is not None)


def test_an_error_that_the_reference_does_not_resolve_is_not_claimed():
    vague = synthetic(MAP, min_error=0.02)
    assert vague.find_cheapest(0.01) is None
    assert vague.describe_verdict()[-1] == "Within 1 %: unknown, because the reference resolves only errors above 2 %."
    assert vague.find_cheapest(0.05) is not None


@pytest.mark.parametrize(
    ("error", "change", "converged"), [(0.04, 0.04, True), (0.06, 0.04, False), (0.04, 0.06, False), (inf, None, False)]
)
def test_converged_is_a_small_error_that_doubling_does_not_change(error: float, change: float | None, converged: bool):
    drawn = synthetic(MAP | {(2, 4): error}, substeps=change or 0.0, iterations=0.0)
    assert drawn.is_converged is converged


def test_the_change_of_two_motions_is_relative_to_the_largest_displacement():
    start, q = np.zeros((2, 3)), np.zeros((3, 2, 3))
    q[:, 1, 0] = 1.0, 4.0, 2.0
    p = q.copy()
    p[2, 1, 1], p[0, 0, 0] = 0.4, 9.0  # the first vertex is pinned, and does not count
    assert measure_change(p, q, start, np.array([1])) == pytest.approx(0.1)


def test_the_effective_stiffness_is_the_true_sag_over_that_of_the_setting(monkeypatch: pytest.MonkeyPatch, scene: Path):
    sags = {None: 0.1, GIVEN_SETTING: 0.4}
    monkeypatch.setattr(SettingSimulator, "measure_sag", lambda self, setting: sags[setting])
    monkeypatch.setattr(setting_convergence, "_find_reference", lambda *given: None)
    (assessment,) = study(scene).assessments
    assert assessment.effective_stiffness == pytest.approx(0.25)


def test_the_drift_is_the_energy_above_the_reference_over_its_largest_kinetic_energy(scene: Path):
    """A chain of mass m that falls 0.5 m and reaches 2 m/s gains 2 m J of kinetic energy and loses 0.5 g m J."""
    scene.write_text(SCENE.replace("{kind: springs, stretch: 200}, ", "").replace(", {kind: pins, parts: [ends]}", ""))
    built = build_scene(load_scene(scene), 6)
    start, mass = built.mesh.rest_positions, float(built.system.mass.sum())
    down, speed = np.array([0.0, -0.5, 0.0]), np.array([0.0, -2.0, 0.0])
    height = 9.81 * float(start[:, 1] @ built.system.mass)
    reference = SampledReference("", np.arange(6), start, start[None], height - 1.0, 4.0, 0.0)
    found = reference.measure_drift(built, start + down, np.tile(speed, (6, 1)))
    assert found == pytest.approx((2.0 * mass - 0.5 * 9.81 * mass + 1.0) / 4.0)
    assert np.isnan(replace(reference, end_energy=None).measure_drift(built, start, start))


def test_a_study_finds_that_a_setting_is_not_converged_and_what_would_be(scene: Path):
    found = study(scene)
    errors = {result.setting: result.error for result in found.results}
    assert len(errors) == 9
    assert min(errors, key=lambda setting: errors[setting]) == (4, 8)
    assert not found.is_converged
    (assessment,) = found.assessments
    assert assessment.substep_change is not None
    assert assessment.substep_change.change > 0.05
    p, q = (found.find_result(StepSetting(k, 4)).positions for k in (2, 4))
    free = np.arange(1, 5)
    start = np.linspace(0, 1, 6)[:, None] * (q[0, -1] - q[0, 0]) + q[0, 0]
    assert assessment.substep_change == (2.0, pytest.approx(measure_change(p, q, start, free), rel=1e-9))
    assert assessment.effective_stiffness == pytest.approx(1.0, abs=0.05), "local-global rests where it should"
    assert all(result.max_strain < 1.0 and not result.reason for result in found.results)


def test_an_unconverged_method_of_constraints_seems_softer(scene: Path):
    simulator = simulate(scene, "xpbd")
    true, soft, stiff = (simulator.measure_sag(one) for one in (None, StepSetting(1, 1), StepSetting(4, 60)))
    assert soft > 1.1 * true
    assert stiff == pytest.approx(true, rel=0.05)


@pytest.mark.slow
def test_without_a_reference_settings_are_compared_with_the_finest(scene: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*given: Any, **how: Any) -> Any:
        raise NotIntegrable("exact lengths")

    monkeypatch.setattr(ReferenceStore, "load_trajectory", refuse)
    found = study(scene)
    assert found.reference == "the finest setting, 4 x 8, because there is no reference"
    assert found.find_result(StepSetting(4, 8)).error == inf
    assert "energy" not in found.describe_verdict()[1]


FLOOR = "obstacles: [{kind: plane, point: [0, %s, 0]}]"
HALF_SPACE = "{kind: contact, %s}" % (FLOOR % -9)
BARRIERS = "{kind: self-contact, min_distance: 0.01, friction: 0.3}, {kind: surface-contact, min_distance: 0.01, %s}"


def touching(
    scene: Path, monkeypatch: pytest.MonkeyPatch, disagreement: list[float], effects: str = HALF_SPACE, solver="sparse"
) -> SettingSimulator:
    """The chain above a floor, with a self-converged motion of this uncertainty at its six frames."""
    contact = f"{effects}]"
    scene.write_text(SCENE.replace("parts: [ends]}]", f"parts: [ends]}}, {contact}"))
    monkeypatch.setattr(self_converged_trajectory, "MAX_RELATIVE_ERROR", 1e3)  # two step sizes are enough
    load = ReferenceStore.load_self_converged
    monkeypatch.setattr(
        ReferenceStore,
        "load_self_converged",
        lambda *given, **how: replace(load(*given, **{**how, "error": 1e3}), disagreement=np.array(disagreement)),
    )
    return simulate(scene, solver)


@pytest.mark.slow
def test_barriers_are_contact_and_their_motion_is_compared(scene: Path, monkeypatch: pytest.MonkeyPatch):
    """A rope that falls onto a floor a hundredth below it: the floor is felt, and the verdict states its reference."""
    simulator = touching(scene, monkeypatch, [0.001] * 6, BARRIERS % (FLOOR % -0.03), "newton")
    found = study_simulator(simulator, scene, [StepSetting(1, 10)], 0.05)
    assert found.reference == "the self-converged motion (known to 0.1 %)"
    given = found.find_result(StepSetting(1, 10))
    assert not given.reason
    assert 0.0 < given.error < 1.0
    assert given.positions[:, :, 1].min() > -0.03
    assert found.find_result(StepSetting(2, 20)).error < given.error


@pytest.mark.slow
def test_with_contact_motions_are_compared_within_the_predictability_horizon(
    scene: Path, monkeypatch: pytest.MonkeyPatch
):
    simulator = touching(scene, monkeypatch, [0.001, 0.002, 0.01, 0.012, 0.016, 0.001])
    found = study_simulator(simulator, scene, [GIVEN_SETTING], 0.05, is_end_given=False)
    assert simulator.num_frames == 4
    assert found.reference == "the self-converged motion (known to 1.2 %)"
    assert found.min_error == pytest.approx(0.04)
    assert "Within 1 %: unknown" in found.describe_verdict()[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "message"), [(0.001, r"up to 0.0333333 s.*use --t-end 0.0333333"), (0.5, "no certified reference")]
)
def test_with_contact_a_time_that_is_too_long_is_refused(
    scene: Path, monkeypatch: pytest.MonkeyPatch, first: float, message: str
):
    simulator = touching(scene, monkeypatch, [first, *[0.5] * 5])
    with pytest.raises(RunFailed, match=message):
        study_simulator(simulator, scene, [GIVEN_SETTING], 0.05)


def test_a_setting_that_is_not_supported_ends_the_study(scene: Path):
    scene.write_text(SCENE.replace("stretch: 200", "stretch: exact"))
    with pytest.raises(RunFailed, match=r"sparse, 2 x 4: sparse: supports finite stiffness only"):
        study(scene)


def test_a_map_marks_the_given_setting_and_the_cheapest_ones() -> None:
    full = {(s, i): 0.3 / (s * i) for s in (1, 2, 4) for i in (2, 4, 8)}
    failed = replace(synthetic(full).results[0], error=inf, reason="diverged in frame 1")
    drawn = replace(synthetic(full), results=(failed, *synthetic(full).results[1:]))
    (shown,) = build_setting_chart(drawn, "Is 2 x 4 converged?", ["facts"]).maps
    assert (shown.row_names, shown.column_names) == (["2", "4", "8"], ["1", "2", "4"])
    cells = {(cell.column, cell.row): cell for cell in shown.cells}
    assert {place for place, cell in cells.items() if cell.is_framed} == {("2", "4")}
    assert cells["2", "4"].value_text.startswith("3.8 %")
    assert cells["2", "4"].value_text.endswith("\ngiven")
    assert [place for place, cell in cells.items() if cell.value_text.endswith("cheapest to 5 %")] == [("1", "8")]
    assert cells["2", "4"].outcome == "2 to 5 %"
    assert cells["1", "2"].value_text.startswith("diverged in")
    assert cells["1", "2"].outcome == "no error"
    assert shown.notes[0] == "facts."


def test_a_map_of_a_single_row_fills_its_sheet(tmp_path: Path) -> None:
    """MuJoCo has substeps and no iterations."""
    drawn = synthetic({(s, 0): 0.3 / s for s in (1, 2, 4)}, given=[StepSetting(2, 0)])
    path, _ = draw_chart_sheets(build_setting_chart(drawn, "Is 2 converged?", ["facts"]), tmp_path / "map")
    image = plt.imread(path)[..., :3]
    coloured = np.ptp(image, axis=2) > 0.1
    assert coloured.mean() > 0.1


@pytest.mark.slow
def test_the_command_writes_the_map_its_numbers_and_the_settings(scene: Path):
    results = scene.parent / "results"
    line = ["convergence", str(scene), "--solver", "newton", "--setting", "1x4", "--doublings", "1"]
    answer = CliRunner().invoke(app, [*line, "--t-end", str(END), "--results", str(results)])
    assert answer.exit_code == 1, answer.output
    (table,) = (results / "convergence-chain").glob("*.csv")
    rows = list(csv.DictReader(table.open()))
    assert {(row["substeps"], row["iterations"]) for row in rows} == {(s, i) for s in "12" for i in "248"}
    assert float(rows[0]["error"]) > float(rows[-1]["error"]) > 0.0
    assert len(list((results / "convergence-chain" / "pictures").glob("*.png"))) == 1
    assert "--solver newton --integrator implicit-euler --time-step 0.03333333333333333 --frames 6" in answer.output
    assert "1 x 4 substeps x iterations: not converged to 5 %" in answer.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--solver", "sparce"], "--solver: got 'sparce'; expected"),
        (["--solver", "sparse", "--setting", "0x4"], "--setting: got '0x4'; expected substeps x iterations"),
        (["--solver", "sparse", "--setting", "4"], "--setting: got 4 substeps; sparse iterates within a substep"),
        (["--solver", "velocity-verlet", "--setting", "4x2"], "has no iterations within a substep"),
        (["--solver", "sparse", "--error", "-1"], "--error: got -1; expected a number above 0"),
        (["--solver", "sparse", "--parameter", "omega"], "--parameter: got 'omega'; expected KEY=VALUE"),
        (["--solver", "sparse", "--t-end", "nan"], "--t-end: got nan"),
    ],
)
def test_mistakes_are_named(scene: Path, arguments: list[str], message: str):
    answer = CliRunner().invoke(
        app, ["convergence", str(scene), *arguments, "--results", str(scene.parent / "results")]
    )
    assert answer.exit_code == 2
    assert message in answer.output


def test_parameters_of_a_solver_are_checked(scene: Path):
    found = read_solver_options(scene, "xpbd-small-steps", [])
    assert found.name == "xpbd-small-steps"
    with pytest.raises(InputError, match="--parameter"):
        read_solver_options(scene, "sparse", ["no_such=1"])


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mujoco") is None, reason="MuJoCo is not installed: pip install 'springbench[mujoco]'")
def test_an_engine_has_a_row_of_substeps_and_a_script(scene: Path):
    results = scene.parent / "results"
    line = ["convergence", str(scene), "--solver", "mujoco", "--setting", "16", "--doublings", "1"]
    answer = CliRunner().invoke(app, [*line, "--t-end", str(END), "--results", str(results)])
    assert answer.exit_code in (0, 1), answer.output
    (table,) = (results / "convergence-chain").glob("*.csv")
    assert [row["substeps"] for row in csv.DictReader(table.open())] == ["8", "16", "32"]
    assert (results / "convergence-chain" / "chain-6-mujoco-16substeps" / "chain.py").is_file()
    assert "mujoco: steps of 0.00208333333 s" in answer.output
