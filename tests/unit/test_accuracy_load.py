"""Accuracy configs become units of work: the studies' grids, what names a unit, and mistakes with their places."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
from springbench.harness.config.accuracy_loader import AccuracyPlan, load_accuracy
from springbench.harness.config.config_loader import load_config
from springbench.harness.errors import InputError
from springbench.harness.report.accuracy.accuracy_data import INITIAL_GUESS_LABELS
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import InitialGuess
from springbench.harness.simulation.time_loop import COARSE_TO_FINE, INITIAL_GUESSES

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SHIPPED_CONFIGS = [
    path for path in sorted(CONFIGS.glob("*.yaml")) if {"curves:", "work:"} & {*path.read_text().splitlines()}
]

CLOTH = """
mesh: {kind: grid}
mass: 1
time_step: 1/30
frames: 5
effects: [{kind: springs, stretch: 100}, {kind: pins, parts: [top]}]
"""
CONFIG = """
scenes: [cloth.yaml, other.yaml]
solvers: [numba, {name: newton}, xpbd]
curves:
  - {scene: cloth, size: 4, snapshot: [early, 3], rounds: 7}
work:
  - {scene: other, size: [4, 5], solver: xpbd, t_end: 0.5, time_step: [1/30, 1/60], rtol: [null, 0.1]}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("cloth.yaml", "other.yaml"):
        (tmp_path / name).write_text(CLOTH)
    return tmp_path


def load_text(folder: Path, text: str) -> AccuracyPlan:
    (folder / "config.yaml").write_text(text)
    return load_accuracy(folder / "config.yaml")


def test_a_study_of_curves_has_each_snapshot_and_solver_that_minimises(folder: Path) -> None:
    units = load_text(folder, CONFIG).curves
    assert [(u.snapshot, u.solver.name) for u in units] == [
        ("early", "numba"),
        ("early", "newton"),
        (3, "numba"),
        (3, "newton"),
    ]
    assert {(u.case.scene_name, u.case.size, u.initial_guesses, u.measurement.rounds) for u in units} == {
        ("cloth", 4, ("previous", "inertial"), 7)
    }


def test_studies_take_every_first_guess_that_is_no_solve_and_reports_have_words_for_each(folder: Path) -> None:
    *guesses, coarse = get_args(InitialGuess)
    assert coarse == COARSE_TO_FINE
    requested = CONFIG.replace("rounds: 7", f"rounds: 7, initial_guess: [{', '.join(guesses)}]")
    assert {unit.initial_guesses for unit in load_text(folder, requested).curves} == {tuple(guesses)}
    assert set(INITIAL_GUESS_LABELS) == set(INITIAL_GUESSES) == set(guesses)


def test_a_study_of_work_has_all_combinations(folder: Path) -> None:
    units = load_text(folder, CONFIG).work
    found = {(u.case.scene_name, u.case.size, u.case.scene.time_step, u.options["rtol"], u.solver.name) for u in units}
    assert found == {
        ("other", size, dt, tolerance, "xpbd")
        for size in (4, 5)
        for dt in (1 / 30, 1 / 60)
        for tolerance in (None, 0.1)
    }
    assert len(units) == len(found)


def test_a_unit_of_two_studies_is_measured_with_the_settings_of_the_first(folder: Path) -> None:
    twice = CONFIG.replace("work:", "  - {scene: cloth, size: 4, snapshot: early, solver: newton, rounds: 2}\nwork:")
    once, both = load_text(folder, CONFIG), load_text(folder, twice)
    assert [(u.build_file_stem(), u.measurement) for u in both.curves] == [
        (u.build_file_stem(), u.measurement) for u in once.curves
    ]


def test_a_unit_with_other_settings_has_the_same_file_and_another_id(folder: Path) -> None:
    accuracy = load_text(folder, CONFIG)
    for unit in (accuracy.curves[0], accuracy.work[0]):
        other = replace(unit, measurement=replace(unit.measurement, rounds=9))
        assert other.build_file_stem() == unit.build_file_stem()
        assert len({unit.compute_unit_id("here"), other.compute_unit_id("here"), unit.compute_unit_id("there")}) == 3


def test_a_changed_scene_is_another_point(folder: Path) -> None:
    before = {unit.build_file_stem() for unit in load_text(folder, CONFIG).curves}
    (folder / "cloth.yaml").write_text(CLOTH.replace("stretch: 100", "stretch: 101"))
    assert not before & {unit.build_file_stem() for unit in load_text(folder, CONFIG).curves}


MISTAKES = [
    ("snapshot: [early", "snapsot: [early", 5, "did you mean 'snapshot'"),
    ("scene: cloth", "scene: clod", 5, "did you mean 'cloth'"),
    ("solver: xpbd", "solver: xpdb", 7, "did you mean 'xpbd'"),
    ("early, 3", "erly, 3", 5, "'early'"),
    ("early, 3", "early, 6", 5, "frame 6 is not among the 5 frames of cloth"),
    ("size: 4,", "", 5, "is missing; the scene cloth needs a mesh size"),
    ("size: 4,", "size: 9999,", 5, "at most"),
    ("t_end: 0.5", "t_end: 0.51", 7, "is no multiple of the time step 0.0333333 s"),
    ("t_end: 0.5", "t_end: 0", 7, "greater than 0"),
    ("rounds: 7", "time_limit: -1", 5, "greater than 0"),
    ("rounds: 7", "initial_guess: [coarse-to-fine]", 5, "which here is a solve"),
    ("cloth.yaml, ", "clod.yaml, ", 2, "there is no file"),
    ("{name: newton}", "{name: newton, order: 2}", 3, "unknown key"),
]


@pytest.mark.parametrize(("before", "after", "line", "said"), MISTAKES, ids=[after for _, after, *_ in MISTAKES])
def test_a_mistake_is_reported_with_its_line(folder: Path, before: str, after: str, line: int, said: str) -> None:
    with pytest.raises(InputError) as refused:
        load_text(folder, CONFIG.replace(before, after))
    assert any(m.line == line and said in m.problem for m in refused.value.mistakes), refused.value


def test_a_sweep_and_an_accuracy_config_are_not_taken_for_each_other(folder: Path) -> None:
    (folder / "sweep.yaml").write_text("scenes: [cloth.yaml]\nsizes: [4]\nsolvers: [numba]\n")
    with pytest.raises(InputError, match="expected an accuracy config"):
        load_accuracy(folder / "sweep.yaml")
    load_text(folder, CONFIG)
    with pytest.raises(InputError, match="springbench accuracy"):
        load_config(folder / "config.yaml")


@pytest.mark.parametrize("path", SHIPPED_CONFIGS, ids=lambda path: path.stem)
def test_every_shipped_config_has_curves_and_names_its_schema(path: Path) -> None:
    requested = load_accuracy(path)
    assert requested.curves or requested.work
    assert path.read_text().splitlines()[0] == "# yaml-language-server: $schema=schema.json"


PAPER = {("liu2013", 81): 1200, ("liu2013", 41): 600, ("liu2013", 21): 300, ("liu2013", 11): 150} | {
    (f"liu2013-k{k}", 21): k for k in (600, 1200, 2400)
}
"""Stiffness [N/m] by scene and size."""


def test_the_paper_is_reproduced_with_its_curtains() -> None:
    units = load_accuracy(CONFIGS / "liu2013.yaml").curves
    frames = {key: set() for key in PAPER}
    for unit in units:
        if unit.solver.name == "numba":
            frames[unit.case.scene_name, unit.case.size].add(unit.snapshot)
    assert all(found == set(range(1, 51)) for found in frames.values())
    cases = {(unit.case.scene_name, unit.case.size): unit.case for unit in units}
    for key, k in PAPER.items():
        scene = build_scene(cases[key].scene, key[1])
        # The rule multiplies by a ratio of sizes: round-off of one product.
        assert abs(scene.all_springs.stiffness / k - 1).max() < 1e-14
        assert abs(scene.system.mass.sum() - 1.0) < 1e-12  # kg; round-off of the sum over 6,561 vertices
        assert cases[key].scene.time_step == 1 / 30
        if key[1] == 81:
            assert len(scene.all_springs.edges) == 32_158
