"""`springbench grade`: readers, frame numbers, vertex order, steps, errors, and mistakes of independent programs."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import InputError
from springbench.harness.experiments.grading.grading import (
    CORRECT,
    MISTAKEN,
    UNCONVERGED,
    GradeRequest,
    PositionGrade,
    SceneGrader,
)
from springbench.harness.experiments.grading.mistaken_programs import MISTAKES as KNOWN_MISTAKES
from springbench.harness.experiments.grading.motion_error import LARGEST_REFERENCE_ERROR
from springbench.harness.experiments.grading.position_files import PositionSequence, read_position_file
from springbench.harness.experiments.grading.step_verdicts import StepAssessor, StepVerdict, spread_order
from springbench.harness.experiments.grading.submission import align_submission, estimate_precision
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import StopRule
from typer.testing import CliRunner

from tests import mistaken_simulations
from tests.mistaken_simulations import read_scene, simulate, write_scene

SHARED_SCENES = Path(__file__).resolve().parents[3] / "shared" / "scenes"
FREE_CHAIN = """
mesh: {kind: chain}
mass: 0.6
time_step: 1/20
frames: 8
default_size: 4
velocity: [0.5, 0.2, -1]
effects: [{kind: springs, stretch: 40}, {kind: gravity}]
"""


COMPRESSED_CHAIN = """
mesh: {kind: chain, length: 1}
mass: 0.6
time_step: 1/20
frames: 1
default_size: 3
effects:
  - {kind: springs, stretch: 4000, scaling_rule: fixed}
  - {kind: pins, parts: [first], weight: exact}
  - {kind: pins, parts: [last], weight: exact, motion: {key_frames: [{time: 0}, {time: 0.05, offset: [-0.3, 0, 0]}]}}
"""


def load_case(folder: Path, name: str = "cloth") -> tuple[Path, dict]:
    """The scene file, and what a program reads from it."""
    path = write_scene(folder, name)
    scene = read_scene(path)
    if scene["m"] is None:
        scene["m"] = build_scene(load_scene(path), 0).system.mass
    return path, scene


def make_grader(path: Path, *, required: int | None = 50, first: int | None = 1, seconds: float = 0.0) -> SceneGrader:
    return SceneGrader(GradeRequest(load_scene(path), 0, required, first, seconds=seconds))


def grade_array(grader: SceneGrader, p: np.ndarray) -> PositionGrade:
    return grader.grade_submission(
        align_submission(grader.scene, PositionSequence(Path("p"), p), grader.request.first_frame)
    )


def grade_steps(path: Path, p: np.ndarray, seconds: float, size: int = 0) -> list[StepVerdict]:
    """The verdicts on the steps alone, without fingerprints."""
    scene = build_scene(load_scene(path), size)
    return StepAssessor(scene).assess_steps(align_submission(scene, PositionSequence(path, p), 1), seconds)


def name_mistake(grader: SceneGrader, p: np.ndarray) -> tuple[str, tuple[str, ...]]:
    """The named mistake, or "", and those that are as close."""
    found = grader.find_fingerprint(
        align_submission(grader.scene, PositionSequence(Path("p"), p), grader.request.first_frame)
    )
    assert found is not None
    return (found.mistake.name if found.mistake else ""), found.alike


def write_folder(folder: Path, p: np.ndarray, suffix: str) -> Path:
    folder.mkdir()
    for k, points in enumerate(p, 1):
        rows = [" ".join(f"{x:.17g}" for x in point) for point in points]
        if suffix == "obj":
            text = "\n".join(f"v {row}" for row in rows)
        else:
            axes = "\n".join(f"property double {axis}" for axis in "xyz")
            text = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{axes}\nend_header\n" + "\n".join(rows)
        (folder / f"frame{k:02d}.{suffix}").write_text(text + "\n")
    return folder


def write_long_table(path: Path, p: np.ndarray) -> Path:
    lines = [
        f"{vertex + 1},{frame},{x!r},{y!r},{z!r}"
        for frame, points in enumerate(p.tolist(), 1)
        for vertex, (x, y, z) in enumerate(points)
    ]
    path.write_text("\n".join(["vertex,frame,x,y,z", *reversed(lines)]))
    return path


def write_wide_table(path: Path, p: np.ndarray) -> Path:
    np.savetxt(path, p.reshape(len(p), -1), delimiter=",", fmt="%.17g")
    return path


def save_array(path: Path, p: np.ndarray) -> Path:
    np.savez(path, positions=p) if path.suffix == ".npz" else np.save(path, p)
    return path


FORMATS: dict[str, Callable[[Path, np.ndarray], Path]] = {
    "npz": lambda folder, p: save_array(folder / "p.npz", p),
    "npy": lambda folder, p: save_array(folder / "p.npy", p),
    "flat-npy": lambda folder, p: save_array(folder / "p.npy", p.reshape(len(p), -1)),
    "wide-csv": lambda folder, p: write_wide_table(folder / "p.csv", p),
    "long-csv": lambda folder, p: write_long_table(folder / "p.csv", p),
    "obj": lambda folder, p: write_folder(folder / "p", p, "obj"),
    "ply": lambda folder, p: write_folder(folder / "p", p, "ply"),
}


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_gives_the_same_positions(form, tmp_path):
    p = np.random.default_rng(1).normal(size=(3, 4, 3))
    np.testing.assert_array_equal(read_position_file(FORMATS[form](tmp_path, p), 4).positions, p)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("p.csv", "1,2,3\n", "3 columns; expected one line a frame of 12 numbers"),
        ("p.csv", "0,0,0,0,0,0,0,0,0,0,0,0\n1,2\n", "p.csv:2: has 2 columns; expected 12"),
        ("p.csv", "0,0,0,0,0,0,0,0,0,0,0,0\n1,two\n", "p.csv:2: is not all numbers"),
        ("p.csv", "frame,vertex,x,y,z\n1,1,0,0,0\n", "each of 4 vertices once"),
        ("p.csv", "frame,x,y,z\n1,0,0,0\n", "expected `vertex` too"),
        ("p.csv", "", "is empty"),
        ("p.csv", "frame,vertex,x,y,z\n1,0.5,0,0,0\n", "its column vertex has 0.5; expected whole numbers"),
        ("p.csv", "frame,vertex,x,y,z\nnan,1,0,0,0\n", "its column frame has nan; expected whole numbers"),
        ("p.csv", "time,vertex,x,y,z\ninf,1,0,0,0\n", "its column time has inf; expected seconds"),
        ("p.csv", "x,x\n0,0\n", "names the column 'x' twice"),
        ("p.csv", "0," * 1000, "p.csv:1: has a line of more than 896 characters; expected at most 14 numbers"),
        ("p.stl", "", "has the suffix '.stl'"),
        ("p.npz", "no zip", "p.npz"),
        ("p.npy", "no array", "p.npy"),
    ],
)
def test_a_file_that_cannot_be_graded_is_refused_with_its_place(name, content, words, tmp_path):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError) as caught:
        read_position_file(tmp_path / name, 4)
    assert words in str(caught.value)
    assert name in str(caught.value)


def test_the_only_array_of_a_file_is_read_and_named(tmp_path):
    path, scene = load_case(tmp_path, "rope")
    np.savez(tmp_path / "p.npz", U=simulate(scene, 3))
    read = read_position_file(tmp_path / "p.npz", 5)
    found = align_submission(make_grader(path).scene, read, 1)
    assert found.notes[0] == "array: `U`, the only one in the file"
    np.savez(tmp_path / "q.npz", U=np.zeros((3, 5, 3)), V=np.zeros((3, 5, 3)))
    with pytest.raises(InputError, match="it contains U, V"):
        read_position_file(tmp_path / "q.npz", 5)
    np.save(tmp_path / "t.npy", np.zeros((5, 3, 3)))
    with pytest.raises(InputError, match=r"\(vertices, frames, 3\) = \(5, 3, 3\); expected \(frames, "):
        read_position_file(tmp_path / "t.npy", 5)


def test_a_folder_with_a_missing_frame_is_refused(tmp_path):
    folder = write_folder(tmp_path / "p", np.zeros((4, 2, 3)), "obj")
    (folder / "frame02.obj").unlink()
    with pytest.raises(InputError, match="files 1 and 3 in a row"):
        read_position_file(folder, 2)


def test_positions_of_another_mesh_are_refused(tmp_path):
    with pytest.raises(InputError, match="has 5 vertices; the scene has 4"):
        read_position_file(save_array(tmp_path / "p.npy", np.zeros((2, 5, 3))), 4)


@pytest.mark.parametrize(
    ("values", "absolute", "relative"),
    [
        (np.round(np.linspace(-1, 1, 999), 6), 5e-7, 2.0**-53),
        (np.linspace(-1, 1, 998).astype(np.float32).astype(float), 0.0, 2.0**-25),
        (np.array([float(f"{x:.5e}") for x in np.geomspace(1e-9, 900, 998)]), 0.0, 5e-6),
        (np.random.default_rng(0).normal(size=99), 0.0, 2.0**-53),
    ],
    ids=["decimals", "float32", "digits", "float64"],
)
def test_the_stored_digits_are_recognised(values, absolute, relative):
    found = estimate_precision(values)
    assert found.absolute == pytest.approx(absolute, abs=1e-300)
    assert found.relative == relative


def test_vertices_in_another_order_are_matched_by_frame_0_and_the_output_states_it(tmp_path):
    path, scene = load_case(tmp_path, "rope")
    grader = make_grader(path, first=None)
    order = np.array([3, 0, 4, 1, 2])
    p = np.concatenate([scene["V"][None], simulate(scene, 4)])
    found = align_submission(grader.scene, PositionSequence(path, p[:, order]))
    np.testing.assert_array_equal(found.positions[1:], p)
    assert any("matched by the positions of frame 0; 5 of 5" in note for note in found.notes)
    assert any("so it is frame 0" in note for note in found.notes)


def test_vertices_are_matched_by_a_file_of_rest_positions_or_refused(tmp_path):
    path, scene = load_case(tmp_path, "rope")
    grader, order = make_grader(path), np.array([3, 0, 4, 1, 2])
    p = simulate(scene, 4)
    read = PositionSequence(path, p[:, order])
    found = align_submission(grader.scene, read, 1, scene["V"][order])
    np.testing.assert_array_equal(found.positions[2:], p)
    with pytest.raises(InputError, match="are not the scene's, one to one"):
        align_submission(grader.scene, read, 1, 2.0 * scene["V"][order])
    unmatched = align_submission(grader.scene, read, 1)
    assert any("no rest positions are given" in note and "as in another order" in note for note in unmatched.notes)
    usual = align_submission(grader.scene, PositionSequence(path, p), 1)
    assert not any("another order" in note for note in usual.notes)


def test_times_of_another_time_step_are_refused(tmp_path):
    path, scene = load_case(tmp_path, "rope")
    read = PositionSequence(path, simulate(scene, 4), times=np.arange(1, 5) / 60)
    with pytest.raises(InputError, match=r"0\.0166667 s for frame 1; the scene's is 0\.0333333 s"):
        align_submission(make_grader(path).scene, read, 1)


def test_positions_that_are_not_finite_are_graded_up_to_there(tmp_path):
    path, scene = load_case(tmp_path, "rope")
    p = simulate(scene, 6)
    p[4, 2] = np.nan
    found = align_submission(make_grader(path).scene, PositionSequence(path, p), 1)
    assert found.num_steps == 4
    assert any("not finite from stored frame 5 on" in note for note in found.notes)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 50])
def test_steps_are_visited_once_each_and_spread(count):
    order = list(spread_order(count))
    assert sorted(order) == list(range(1, count + 1))
    assert order[:2] == [1, count][:count]


def test_a_correct_program_is_correct_and_a_mistake_is_named(tmp_path):
    path, scene = load_case(tmp_path)
    grader = make_grader(path)
    good = grade_array(grader, simulate(scene, 8))
    assert good.kind == CORRECT
    assert good.fingerprint is not None
    assert good.fingerprint.iterations == 50
    assert good.num_minima == 8
    bad = grade_array(grader, simulate(scene, 8, "k not in b"))
    assert bad.kind == MISTAKEN
    assert "k left out of b" in bad.verdict
    assert bad.num_minima == 0


@pytest.mark.parametrize("seconds", [0.0, 5.0])
def test_positions_collapsed_to_a_point_are_no_minimum(seconds, tmp_path):
    """No spring has a direction there: the round-off of the residual is unbounded, and the gap is what shows it."""
    path, scene = load_case(tmp_path)
    V = scene["V"]
    for p in (np.zeros((4, *V.shape)), np.tile(V.mean(axis=0), (4, len(V), 1))):
        steps = grade_steps(path, np.concatenate([simulate(scene, 3), p]), seconds)
        assert [one.is_minimum for one in steps] == [True] * 3 + [False] * 4
        assert all(one.gap > 1.0 for one in steps[3:] if one.gap is not None)


@pytest.mark.parametrize("digits", [np.float32, 3, 5])
def test_minima_in_few_digits_are_minima_by_their_gap_too(digits, tmp_path):
    path, scene = load_case(tmp_path)
    p = simulate(scene, 8, iterations=400)
    stored = p.astype(digits).astype(float) if digits is np.float32 else np.round(p, digits)
    steps = grade_steps(path, stored, 20.0)
    assert all(one.is_minimum and one.gap is not None and one.gap_floor > 0.0 for one in steps)


def test_a_saddle_is_no_minimum(tmp_path):
    """Two springs are pressed along their line: where their middle is in equilibrium there, it buckles."""
    (tmp_path / "rod.yaml").write_text(COMPRESSED_CHAIN)
    scene = build_scene(load_scene(tmp_path / "rod.yaml"), 3)
    p, inertia = (
        scene.mesh.rest_positions + np.array([[0, 0, 0], [0, 0, 0], [-0.3, 0, 0]]),
        20**2 * scene.system.mass[1],
    )
    p[1, 0] = (4000 * (p[0, 0] + p[2, 0]) + inertia * p[1, 0]) / (8000 + inertia)
    (step,) = grade_steps(tmp_path / "rod.yaml", p[None], 5.0, size=3)
    assert step.residual < 1e-9
    assert step.gap is not None
    assert step.gap > 0.01
    assert not step.is_minimum


def test_a_scene_without_required_iterations_requires_convergence(tmp_path):
    path, scene = load_case(tmp_path)
    found = grade_array(make_grader(path, required=None), simulate(scene, 6, iterations=12))
    assert found.kind == UNCONVERGED
    assert "12 iterations" in found.verdict


@pytest.mark.slow
def test_momentum_of_a_scene_without_pins_is_balanced_and_a_lost_impulse_is_measured(tmp_path):
    (tmp_path / "chain.yaml").write_text(FREE_CHAIN)
    spec = load_scene(tmp_path / "chain.yaml")
    grader = SceneGrader(GradeRequest(spec, 4, None, 1, seconds=5.0))
    scene, dt = build_scene(spec, 4), 1 / 20
    n = len(scene.mesh.rest_positions)
    V, v0, g = scene.mesh.rest_positions, np.array([0.5, 0.2, -1]), np.array([0, -9.81, 0])
    p = np.array([V + k * dt * v0 + dt**2 * g * k * (k + 1) / 2 for k in range(1, 9)])  # a rigid fall
    good = grade_array(grader, p)
    assert good.quantities.momentum_error is not None
    assert good.quantities.momentum_error.max() < 1e-12
    assert good.kind == CORRECT
    assert good.quantities.max_strain.max() < 1e-12
    assert good.shares[-1].total == pytest.approx(good.shares[-1].time_step_share, rel=1e-6)
    exact = V + 0.4 * v0 + 0.5 * g * 0.4**2
    moved = np.linalg.norm(exact - V)
    assert good.shares[-1].total == pytest.approx(np.linalg.norm(p[-1] - exact) / moved, rel=1e-6)
    assert good.shares[-1].solver_share < 1e-9
    mass, fallen = scene.system.mass.sum(), p[:, 0, 1] - V[0, 1]
    speed = np.linalg.norm(v0 + dt * np.arange(1, 9)[:, None] * g, axis=1)
    energy = 0.5 * mass * speed**2 + 9.81 * mass * fallen
    assert good.quantities.energy[1:] == pytest.approx(energy, rel=1e-9), "kinetic energy and height"
    p[4:] += 0.01
    bad = grade_array(grader, p)
    momentum_error: Any = bad.quantities.momentum_error
    assert momentum_error.max() > 1e-3
    assert bad.shares[-1].time_step_share == pytest.approx(good.shares[-1].time_step_share, rel=1e-6)
    away = np.linalg.norm(p[-1] - exact) / moved
    assert bad.shares[-1].total == pytest.approx(away, rel=1e-6)
    assert n == len(V)


CONTACT = """
mesh: {kind: grid}
mass: 0.5
time_step: 1/60
frames: 20
default_size: 3
effects:
  - {kind: springs, stretch: 400}
  - {kind: gravity}
  - {kind: contact, friction: %s, obstacles: [{kind: plane, point: [0, -0.3, 0], normal: [0.2, 1, 0]}]}
"""


@pytest.mark.long
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_scenes_with_contact_are_graded_by_converged_steps_whose_error_is_stated(friction, tmp_path):
    (tmp_path / "drop.yaml").write_text(CONTACT % friction)
    grader = SceneGrader(GradeRequest(load_scene(tmp_path / "drop.yaml"), 3, None, 1, seconds=1.5))
    scene = grader.scene
    run = simulate_scene(
        scene, prepare(scene, NewtonSolver()), StopRule(100, 1e-8), initial_guess="previous", frames=20
    )
    p = np.array([step.positions for step in run])
    good = grade_array(grader, p)
    assert good.kind == CORRECT
    assert good.num_minima == 20
    assert good.quantities.momentum_error is None  # the plane takes momentum
    assert good.shares
    for one in good.shares:
        assert one.reference_kind == "self-converged"
        assert 0.0 < one.reference_error <= LARGEST_REFERENCE_ERROR
        assert one.solver_share < 1e-4
        assert one.total == pytest.approx(one.time_step_share, rel=1e-3)
    p[10:] += 0.01
    bad = grade_array(grader, p)
    assert bad.kind != CORRECT
    assert bad.num_minima < 20


@pytest.mark.slow
def test_the_command_grades_one_submission_and_writes_its_steps(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, scene = load_case(tmp_path)
    np.savez("p.npz", positions=simulate(scene, 8, "one iteration"))
    answer = CliRunner().invoke(app, ["grade", "p.npz", path.name, "--budget", "2", "--csv", "steps.csv"])
    assert answer.exit_code == 1, answer.output
    for words in ("too few iterations", "takes 1 iteration a step instead of 50", "it is frame 1", "largest strain"):
        assert words in answer.output
    with open("steps.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["step"] for line in lines] == [str(k) for k in range(1, 9)]
    assert all(float(line["residual"]) > 1e-6 for line in lines)


def test_progress_of_a_grade_counts_the_minima_with_the_remaining_time(tmp_path):
    path, scene = load_case(tmp_path, "rope")
    built = build_scene(load_scene(path), 0)
    submission = align_submission(built, PositionSequence(path, simulate(scene, 5)), 1)
    lines: list[str] = []
    StepAssessor(built).assess_steps(submission, 60.0, lines.append)
    assert lines[0] == "minimum 1 of 5"
    assert [re.sub(r"\d+ s", "T", line) for line in lines[1:]] == [
        f"minimum {k} of 5; about T left" for k in range(2, 6)
    ]


@pytest.mark.slow
def test_the_command_grades_a_folder_of_students(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, scene = load_case(tmp_path, "rope")
    (tmp_path / "class").mkdir()
    save_array(tmp_path / "class" / "ada.npz", simulate(scene, 6))
    save_array(tmp_path / "class" / "bob.npy", simulate(scene, 6, "previous overwritten"))
    (tmp_path / "class" / "eve.csv").write_text("1,2,3\n")
    (tmp_path / "class" / "fay").mkdir()
    write_folder(tmp_path / "class" / "fay" / "out", simulate(scene, 6), "obj")
    options = ["--students", "--budget", "0.5", "--csv", "class.csv"]
    answer = CliRunner().invoke(app, ["grade", "class", path.name, *options])
    assert answer.exit_code == 0, answer.output
    with open("class.csv", newline="") as file:
        found = {line["submission"]: line for line in csv.DictReader(file)}
    assert {name: line["verdict"] for name, line in found.items()} == {
        "ada": "correct",
        "bob": "mistake",
        "eve": "not graded",
        "fay": "correct",
    }
    assert found["bob"]["mistake"] == "no inertia"
    assert "has 3 columns" in answer.output
    assert "[0/4] grading ada" in answer.output
    assert re.search(r"\[3/4\] grading fay; about \d+ s left", answer.output)


def test_mistakes_of_the_command_line_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path, _ = load_case(tmp_path, "rope")
    for arguments, words in (
        (["p.npz", path.name], "there is no such file"),
        ([path.name, path.name, "--students"], "--students needs one"),
        (["p.npz", path.name, "--csv", "steps.txt"], "ends in .csv"),
        (["p.npz", "none.json"], "none.json"),
    ):
        answer = CliRunner().invoke(app, ["grade", *arguments])
        assert answer.exit_code == 2, answer.output
        assert words in answer.output


def test_there_are_at_least_fifteen_mistakes_each_with_a_program_that_makes_it():
    known = {one.name for one in KNOWN_MISTAKES} | {"too few iterations", "wrong time step"}
    assert set(mistaken_simulations.MISTAKES.values()) <= known
    assert len(set(mistaken_simulations.MISTAKES.values())) >= 15


@pytest.mark.long
@pytest.mark.parametrize("name", ["cloth", "sheet"])
def test_programs_with_each_mistake_name_it(name, tmp_path):
    path, scene = load_case(tmp_path, name)
    grader, wrong = make_grader(path), dict[str, str]()
    for mistake, expected in mistaken_simulations.MISTAKES.items():
        with np.errstate(all="ignore"):
            named, alike = name_mistake(grader, simulate(scene, 20, mistake))
        if named != expected and expected not in alike:
            wrong[mistake] = named
    assert wrong == {}


@pytest.mark.long
@pytest.mark.parametrize("name", ["single-spring-horizontal", "horizontal-chain", "net"])
def test_mistakes_on_the_published_scenes_are_named_or_reported_as_invisible(name, tmp_path):
    path = SHARED_SCENES / f"{name}.json"
    if not path.exists():
        pytest.skip("the assignment's scenes are not part of this repository")
    scene, grader, wrong = read_scene(path), make_grader(path), dict[str, str]()
    for mistake, expected in mistaken_simulations.MISTAKES.items():
        with np.errstate(all="ignore"):
            p = simulate(scene, 20, mistake)
            submission = align_submission(grader.scene, PositionSequence(path, p), 1)
        found = grader.find_fingerprint(submission)
        assert found is not None
        named = found.mistake.name if found.mistake else ""
        same = float(np.abs(p - simulate(scene, 20)).max()) < 1e-6 * float(np.abs(scene["V"]).max())
        if named != expected and expected not in (*found.alike, *found.invisible) and not (same and not named):
            wrong[mistake] = named
    assert len(wrong) <= len(mistaken_simulations.MISTAKES) // 15, wrong


@pytest.mark.long
def test_no_correct_program_is_accused(tmp_path):
    cases = {name: load_case(tmp_path, name) for name in mistaken_simulations.SCENES}
    graders = {name: make_grader(path) for name, (path, _) in cases.items()}
    accused = dict[int, str]()
    for seed in range(100):
        rng = np.random.default_rng(seed)
        name = str(rng.choice(list(cases)))
        named, _ = name_mistake(graders[name], mistaken_simulations.simulate_otherwise(cases[name][1], 20, rng))
        if named:
            accused[seed] = named
    assert accused == {}
