"""Scenes and sweeps become runs: the grid, what is left out and added, and the names of runs."""

from __future__ import annotations

import json
import subprocess
import sys
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.api import Simulation
from springbench.harness.config.config_loader import SweepPlan, load_config, load_scene, load_sweep
from springbench.harness.config.json_schema import build_json_schema
from springbench.harness.config.run_options import DEFAULT_SOLVER, DEFAULT_STOP_RULE
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError
from springbench.harness.scenes.scene_builder import build_scene

ROOT = Path(__file__).resolve().parents[2]
ASSIGNMENT = ROOT.parent / "shared" / "scenes"
OTHERS = {"curves:", "work:"}
CONFIGS = [p for p in sorted((ROOT / "configs").glob("*.yaml")) if not OTHERS & {*p.read_text().splitlines()}]
CONFIGS += [*sorted((ROOT / "configs" / "scenes").glob("*.yaml"))]

CLOTH = """
mesh: {kind: grid, width: 1}
mass: 1
time_step: 1/30
frames: 5
effects:
  - {kind: springs, scaling_rule: fixed, stretch: 1e3}
"""
FILE = CLOTH.replace("{kind: grid, width: 1}", "{kind: file, path: mesh.obj}")
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
SWEEP = """
scenes: [cloth.yaml, file.yaml]
sizes: [4, 8]
solvers: [sparse, dense]
options: {max_iterations: [10, 20]}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in {"cloth.yaml": CLOTH, "file.yaml": FILE, "mesh.obj": OBJ}.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def sweep_of(folder: Path, text: str) -> SweepPlan:
    (folder / "sweep.yaml").write_text(text)
    return load_sweep(folder / "sweep.yaml")


def points(runs: list[RunSpec]) -> list[tuple[str, int, str, int]]:
    return [(run.scene_name, run.size, run.solver.name, run.max_iterations) for run in runs]


GRID = [
    *[("cloth", size, solver, its) for size in (4, 8) for solver in ("sparse", "dense") for its in (10, 20)],
    *[("file", 0, solver, its) for solver in ("sparse", "dense") for its in (10, 20)],
]


def test_a_sweep_is_every_combination_in_the_order_of_its_lists(folder: Path) -> None:
    assert points(sweep_of(folder, SWEEP).list_runs()) == GRID


REMAINING_POINTS = {
    "{solver: dense}": lambda s, n, v, i: v != "dense",
    "{solver: dense, size_above: 4}": lambda s, n, v, i: not (v == "dense" and n > 4),
    "{size_below: 8, scene: cloth}": lambda s, n, v, i: not (s == "cloth" and n < 8),
    "{scene: cloth, size: [4, 8], max_iterations: 10}": lambda s, n, v, i: not (s == "cloth" and i == 10),
    "{scene: file}, {max_iterations: 20}": lambda s, n, v, i: s != "file" and i != 20,
    "{rtol: null, max_iterations: 10}": lambda s, n, v, i: i != 10,
    "{initial_guess: previous, frames: 5, solver: sparse}": lambda s, n, v, i: v != "sparse",
    "{initial_guess: null, frames: null, time_step: null, solver: sparse}": lambda s, n, v, i: v != "sparse",
}


@pytest.mark.parametrize("entry", REMAINING_POINTS)
def test_a_grid_point_that_matches_all_keys_of_an_exclude_is_left_out(folder: Path, entry: str) -> None:
    runs = sweep_of(folder, f"{SWEEP}exclude: [{entry}]\n").list_runs()
    assert points(runs) == [point for point in GRID if REMAINING_POINTS[entry](*point)]


ADDED_POINTS = {
    "{scene: cloth, size: 16, solver: dense}": [("cloth", 16, "dense", 10)],
    "{size: [16, 24], solver: dense, max_iterations: [5, 6]}": [
        *[("cloth", size, "dense", its) for size in (16, 24) for its in (5, 6)],
        *[("file", 0, "dense", its) for its in (5, 6)],
    ],
    "{scene: file, max_iterations: 7}": [("file", 0, "sparse", 7), ("file", 0, "dense", 7)],
    "{scene: cloth, size: 8}": [],
}


@pytest.mark.parametrize("entry", ADDED_POINTS)
def test_an_include_adds_its_runs_and_no_run_twice(folder: Path, entry: str) -> None:
    assert points(sweep_of(folder, f"{SWEEP}include: [{entry}]\n").list_runs()) == GRID + ADDED_POINTS[entry]


def test_an_include_survives_the_excludes(folder: Path) -> None:
    text = f"{SWEEP}exclude: [{{scene: cloth}}]\ninclude: [{{scene: cloth, size: 4, solver: dense}}]\n"
    assert points(sweep_of(folder, text).list_runs()) == [*GRID[8:], ("cloth", 4, "dense", 10)]


def test_what_a_sweep_leaves_out_comes_from_the_scene_or_the_defaults(folder: Path) -> None:
    (run,) = load_config(folder / "cloth.yaml", sizes=[4]).list_runs()
    assert (run.sweep, run.scene_name, run.size) == ("cloth", "cloth", 4)
    assert (run.initial_guess, run.threads) == ("previous", "auto")
    assert (run.frames, run.rounds, run.convergence_frames, run.strain_range) == (5, 2, None, None)
    assert run.scene.time_step == 1 / 30
    assert run.record
    assert run.pictures


def stop(run: RunSpec) -> tuple[str, int, Any]:
    return run.solver.name, run.max_iterations, run.rtol


def test_one_scene_is_solved_to_a_tolerance_by_the_recommended_solver_as_in_python(folder: Path) -> None:
    scene = folder / "cloth.yaml"
    (run,), (other,) = (
        load_config(scene, sizes=[4]).list_runs(),
        load_config(scene, sizes=[4], solvers=["sparse"]).list_runs(),
    )
    assert stop(run) == (DEFAULT_SOLVER, *DEFAULT_STOP_RULE.values()) == ("hybrid", 500, 1e-4)
    assert stop(other) == ("sparse", 500, 1e-4)
    usual = signature(Simulation).parameters
    assert stop(run) == tuple(usual[name].default for name in ("solver", "max_iterations", "rtol"))


@pytest.mark.parametrize("options", [{"max_iterations": 7}, {"rtol": None}, {"rtol": 1e-3}, {"error_target": 1e-2}])
def test_stop_rules_in_python_have_the_meaning_that_they_have_in_a_sweep(folder: Path, options: dict[str, Any]) -> None:
    (run,) = load_config(folder / "cloth.yaml", sizes=[4], **options).list_runs()
    assert stop(run) == ("hybrid", options.get("max_iterations", 50), options.get("rtol"))


def test_options_of_the_command_line_make_the_grid_of_a_lone_scene(folder: Path) -> None:
    runs = load_config(folder / "cloth.yaml", solvers=["dense", "sparse"], sizes=[4, 6], frames=2).list_runs()
    assert [(run.size, run.solver.name, run.frames) for run in runs] == [
        (4, "dense", 2),
        (4, "sparse", 2),
        (6, "dense", 2),
        (6, "sparse", 2),
    ]


def compute_run_id(folder: Path, text: str = "", machine: str = "machine", **options: Any) -> str:
    if text:
        (folder / "cloth.yaml").write_text(text)
    (run,) = load_config(folder / "cloth.yaml", sizes=[4], **options).list_runs()
    return run.compute_run_id(machine)


CHANGES = {
    "frames": {"frames": 6},
    "iterations": {"max_iterations": 51},
    "tolerance": {"rtol": 1e-3},
    "first guess": {"initial_guess": "inertial"},
    "threads": {"threads": 2},
    "rounds": {"rounds": 3},
    "solver": {"solvers": ["dense"]},
    "strain range": {"strain_range": 0.2},
    "convergence frames": {"convergence_frames": [1]},
    "machine": {"machine": "another"},
    "mass": {"text": CLOTH.replace("mass: 1", "mass: 2")},
    "time step": {"text": CLOTH.replace("1/30", "1/60")},
    "mesh": {"text": CLOTH.replace("width: 1", "width: 2")},
    "stiffness": {"text": CLOTH.replace("1e3", "1001")},
    "an effect": {"text": CLOTH + "  - {kind: gravity}\n"},
}


@pytest.mark.parametrize("change", CHANGES)
def test_all_that_determines_a_result_changes_the_run_id(folder: Path, change: str) -> None:
    assert compute_run_id(folder) != compute_run_id(folder, **CHANGES[change])


SAME = {
    "comment": "# a comment\n" + CLOTH,
    "description": CLOTH + "description: A cloth.\n",
    "order of keys": "frames: 5\n" + CLOTH.replace("frames: 5\n", ""),
    "spelling of a number": CLOTH.replace("1e3", "1000.0").replace("1/30", repr(1 / 30)),
    "default spelled out": CLOTH.replace("fixed,", "fixed, bend: 0,"),
    "default size": CLOTH + "default_size: 9\n",
}


def test_pictures_are_no_part_of_the_run_id_for_they_are_drawn_from_recordings(folder: Path) -> None:
    assert compute_run_id(folder) == compute_run_id(folder, pictures=False)


@pytest.mark.parametrize("change", SAME)
def test_equivalent_configs_have_the_same_run_id(folder: Path, change: str) -> None:
    assert compute_run_id(folder) == compute_run_id(folder, SAME[change])


def test_the_names_of_the_sweep_and_of_the_mesh_file_are_no_part_of_the_run_id(folder: Path) -> None:
    (run,) = load_config(folder / "file.yaml").list_runs()
    (folder / "mesh.obj").rename(folder / "renamed.obj")
    (folder / "file.yaml").write_text(FILE.replace("mesh.obj", "renamed.obj"))
    (again,) = load_config(folder / "file.yaml").list_runs()
    assert again.replace_options(sweep="other").compute_run_id("m") == run.compute_run_id("m")


def test_the_content_of_the_mesh_file_is_part_of_the_run_id(folder: Path) -> None:
    (run,) = load_config(folder / "file.yaml").list_runs()
    (folder / "mesh.obj").write_text(OBJ.replace("v 1 0 0", "v 1.0000001 0 0"))
    (again,) = load_config(folder / "file.yaml").list_runs()
    assert again.compute_run_id("m") != run.compute_run_id("m")


def test_a_label_names_the_run_and_fits_a_file_name(folder: Path) -> None:
    (run,) = load_config(folder / "cloth.yaml", sizes=[4]).list_runs()
    assert run.build_file_stem("m") == f"cloth-4-hybrid-{run.compute_run_id('m')}"
    assert len(run.compute_run_id("m")) == 12
    assert set(run.compute_run_id("m")) <= set("0123456789abcdef")


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_shipped_config_has_runs_and_names_its_schema(path: Path) -> None:
    assert load_config(path).list_runs()
    relative = "schema.json" if path.parent.name == "configs" else "../schema.json"
    assert path.read_text().splitlines()[0] == f"# yaml-language-server: $schema={relative}"


def test_the_committed_schema_is_the_models() -> None:
    is_current = json.loads((ROOT / "configs" / "schema.json").read_text()) == build_json_schema()
    assert is_current, "regenerate it: springbench schema > configs/schema.json"


def test_the_schema_describes_every_key_of_a_scene_and_a_sweep() -> None:
    definitions = build_json_schema()["$defs"]
    for name in (
        "Scene",
        "Sweep",
        "SweepOptions",
        "IncludeEntry",
        "ExcludeEntry",
        "Accuracy",
        "CurveStudyConfig",
        "WorkStudyConfig",
    ):
        assert all(key.get("description") for key in definitions[name]["properties"].values()), name


def test_a_scene_imports_the_effects_that_it_names_and_no_others(folder: Path) -> None:
    code = (
        "import json, sys; from pathlib import Path; from springbench.harness.config.config_loader import load_scene;"
        "load_scene(Path(sys.argv[1]));"
        "print(json.dumps([m for m in sys.modules if m.startswith('springbench.harness.scenes.effects.')]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder / "cloth.yaml")], capture_output=True, text=True, check=True, cwd=ROOT
    )
    expected = {
        "springbench.harness.scenes.effects.effect_interface",
        "springbench.harness.scenes.effects.effect_table",
        "springbench.harness.scenes.effects.springs_effect",
    }
    assert set(json.loads(done.stdout)) == expected


needs_assignment = pytest.mark.skipif(
    not ASSIGNMENT.is_dir(), reason="the assignment's scenes are not beside the project"
)

# vertices, springs, stiffness, pins, total mass: the table of the assignment's README
FACTS = {
    "single-spring-horizontal": (2, 1, 500.0, 1, 2.0),
    "horizontal-chain": (10, 9, 500.0, 2, 10.0),
    "net": (61, 156, 300.0, 6, 61.0),
    "flag": (3200, 12442, 1e5, 40, 2.0),
}


@needs_assignment
@pytest.mark.parametrize("name", FACTS)
def test_an_assignment_file_is_the_scene_with_its_conventions(name: str) -> None:
    vertices, springs, stiffness, pins, mass = FACTS[name]
    spec = load_scene(ASSIGNMENT / f"{name}.json")
    scene = build_scene(spec, 0)
    assert (len(scene.mesh.rest_positions), len(scene.all_springs.edges)) == (vertices, springs)
    assert set(scene.all_springs.stiffness) == {stiffness}
    assert len(scene.system.pins.vertices) == pins
    assert set(scene.system.pins.weight) == {1e10}
    # the table gives the flag's mass to two digits; the others are whole
    assert scene.system.mass.sum() == pytest.approx(mass, rel=0.05 if name == "flag" else 1e-12)
    assert np.array_equal(scene.constant_force, np.tile([0.0, -9.8, 0.0], (vertices, 1)))
    assert scene.varying_forces == ()
    assert (spec.time_step, spec.frames, spec.initial_guess) == (1 / 30, 30, "assignment")
    (run,) = load_config(ASSIGNMENT / f"{name}.json").list_runs()
    assert (run.initial_guess, stop(run), run.size) == ("assignment", ("numba", 50, None), 0)


def test_mistakes_of_two_scenes_are_reported_together(folder: Path) -> None:
    for name in ("one.yaml", "two.yaml"):
        (folder / name).write_text(CLOTH.replace("mass: 1", "mass: -1"))
    with pytest.raises(InputError) as caught:
        sweep_of(folder, SWEEP.replace("cloth.yaml, file.yaml", "one.yaml, two.yaml"))
    assert [mistake.file for mistake in caught.value.mistakes] == [folder / "one.yaml", folder / "two.yaml"]
