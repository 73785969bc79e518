"""Frozen step problems: what is saved comes back to the last bit, and is taken again where the scene has changed."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.errors import RunFailed
from springbench.harness.reference import step_snapshot
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.step_snapshot import (
    StepSnapshot,
    build_exact_scene,
    run_reference,
    select_snapshot_frames,
)
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.primitive_obstacles import PlaneObstacle
from springbench.harness.scenes.scene_spec import IntegratorName, SceneSpec
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import INTEGRATORS
from springbench.solvers.model.step_problem import StepProblem, StepStart, StopRule, System

FRAMES = 12
SPEC = SceneSpec(
    mesh=GridMesh(),
    mass=1.0,
    time_step=1 / 30,
    frames=FRAMES,
    velocity=(0.0, 0.0, 0.5),
    effects=(
        SpringsEffect(stretch=100.0),
        GravityEffect(),
        EtherDragEffect(decay_rate=0.5),
        PinsEffect(parts=("top_corners",)),
    ),
    path=Path("scene.yaml"),
)
SIZE = 4

integrators = pytest.mark.parametrize("integrator", [name for name in INTEGRATORS if name != "substepping"])


def change_spec(**values) -> SceneSpec:
    """The scene with other values."""
    return SceneSpec.model_construct(None, **{k: getattr(SPEC, k) for k in SceneSpec.model_fields} | values)


class Refuses(NewtonSolver):
    """A solver that must not be called."""

    def prepare(self, system: System):
        raise AssertionError("what was found once is found again")


def arrays(frozen: StepSnapshot) -> dict[str, np.ndarray]:
    """All that a problem is made of, its system's energies apart."""
    named = {
        f.name: getattr(frozen.problem, f.name) for f in fields(StepProblem) if f.name not in ("system", "step_start")
    }
    named |= {f"start {f.name}": np.asarray(getattr(frozen.problem.step_start, f.name)) for f in fields(StepStart)}
    return named | {"after p": frozen.end_motion.positions, "after v": frozen.end_motion.velocity}


def is_identical(one: StepSnapshot, other: StepSnapshot) -> bool:
    """Whether two frozen problems are the same to the last bit."""
    pairs = zip(arrays(one).values(), arrays(other).values(), strict=True)
    systems = one.problem.system, other.problem.system
    return (
        all(np.array_equal(a, b) for a, b in pairs)
        and (one.frame, one.digest) == (other.frame, other.digest)
        and len({(s.inertia_factor, s.time_step, s.mass.tobytes()) for s in systems}) == 1
    )


@integrators
def test_a_step_snapshot_is_restored_from_disk_to_the_last_bit(tmp_path, integrator: IntegratorName):
    taken = ReferenceStore(tmp_path).load_snapshots(SPEC, SIZE, integrator)
    found = ReferenceStore(tmp_path, Refuses()).load_snapshots(SPEC, SIZE, integrator)
    assert list(taken) == list(found) == ["early", "middle", "peak"]
    assert all(is_identical(taken[moment], found[moment]) for moment in taken)
    assert not any(array.flags.writeable for one in found.values() for array in arrays(one).values() if array.ndim)
    p = np.random.default_rng(0).normal(size=(SIZE * SIZE, 3))
    for moment, one in taken.items():
        assert one.problem.value(p) == found[moment].problem.value(p)
        np.testing.assert_array_equal(one.problem.gradient(p), found[moment].problem.gradient(p))


@integrators
def test_a_step_snapshot_is_the_step_of_a_converged_run_with_exact_pins(tmp_path, integrator: IntegratorName):
    frozen = ReferenceStore(tmp_path).load_frames(SPEC, SIZE, [1, 5], integrator)
    scene = build_exact_scene(SPEC, SIZE, integrator)
    run = simulate_scene(
        scene, prepare(scene, NewtonSolver()), StopRule(100, 1e-12), initial_guess="previous", frames=5
    )
    steps = {step.index: step.problem for step in run}
    for frame, one in frozen.items():
        assert one.problem.system.pins.exact_mask.all()
        assert one.problem.system.inertia_factor == steps[frame].system.inertia_factor
        for name in ("inertial_target", "external_force", "pin_targets", "current_positions"):
            np.testing.assert_array_equal(getattr(one.problem, name), getattr(steps[frame], name))


@integrators
def test_a_run_resumes_from_a_step_snapshot_as_if_it_had_never_stopped(tmp_path, integrator: IntegratorName):
    """BDF2 needs the motion one step before as well, as the velocity filter left it."""
    at_once = ReferenceStore(tmp_path / "once").load_frames(SPEC, SIZE, [3, 4, 9], integrator)
    store = ReferenceStore(tmp_path / "bits")
    bit_by_bit = {frame: store.load_frames(SPEC, SIZE, [frame], integrator)[frame] for frame in (3, 4, 9)}
    assert all(is_identical(at_once[frame], bit_by_bit[frame]) for frame in at_once)
    backwards = store.load_frames(SPEC, SIZE, [2, 3], integrator)
    assert is_identical(backwards[3], at_once[3])


def test_the_first_guess_is_chosen_at_use(tmp_path):
    (one,) = ReferenceStore(tmp_path).load_frames(SPEC, SIZE, [3]).values()
    pinned = one.problem.system.pins.vertices
    guess = one.problem.inertial_target.copy()
    guess[pinned] = one.problem.pin_targets
    np.testing.assert_array_equal(one.build_problem("inertial").initial_guess, guess)
    np.testing.assert_array_equal(one.build_problem("previous").initial_guess, one.problem.current_positions)
    assert np.abs(guess - one.problem.current_positions).max() > 1e-4


def test_a_first_guess_beyond_an_obstacle_is_where_the_step_starts(tmp_path):
    below = SurfaceContactEffect(min_distance=0.01, obstacles=(PlaneObstacle(point=(0.0, -0.05, 0.0)),))
    spec = change_spec(effects=(SpringsEffect(stretch=50.0), GravityEffect(), below), velocity=(0.0, -8.0, 0.0))
    made = build_exact_scene(spec, 3)
    state = build_initial_state(made)
    stated = StepSnapshot(1, build_problem(made, state, "previous"), state.motion, "").build_problem("inertial")
    assert stated.inertial_target[:, 1].max() < -0.06, "by inertia alone it would be beyond"
    np.testing.assert_array_equal(stated.initial_guess, state.motion.positions)


def test_the_peak_snapshot_is_the_step_with_the_largest_initial_gap():
    scene, length = build_exact_scene(SPEC, SIZE), 30  # it swings through its lowest point after half a second
    saved, objective_decrease = run_reference(scene, NewtonSolver(), length)
    run = list(
        simulate_scene(
            scene, prepare(scene, NewtonSolver()), StopRule(100, 1e-12), initial_guess="previous", frames=length
        )
    )
    gap = [
        step.problem.value(step.problem.current_positions) - step.problem.value(step.solution.positions) for step in run
    ]
    np.testing.assert_allclose(
        objective_decrease, gap, rtol=1e-9
    )  # differences of sums that are some hundred times as large
    violent = 2 + int(np.argmax(gap[1:]))
    assert 2 < violent < length
    assert set(saved) == {3, 15, violent}


@pytest.mark.parametrize(
    ("objective_decrease", "expected"),
    [
        ([1.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], (2, 6, 4)),
        ([9.0, 1.0, 2.0], (2, 2, 3)),  # BDF2 takes its first step by another method
        ([1.0], (1, 1, 1)),
        (np.arange(60.0), (6, 30, 60)),
    ],
)
def test_snapshots_are_at_a_tenth_and_a_half_of_the_run_and_at_its_peak(objective_decrease, expected):
    assert tuple(select_snapshot_frames(np.array(objective_decrease), len(objective_decrease)).values()) == expected


CHANGES = {
    "stiffness": {"effects": (SpringsEffect(stretch=101.0), *SPEC.effects[1:])},
    "mass": {"mass": 1.1},
    "time step": {"time_step": 1 / 60},
    "speed": {"velocity": (0.0, 0.1, 0.5)},
}


@pytest.mark.parametrize("change", CHANGES)
def test_another_scene_is_another_problem(tmp_path, change):
    store = ReferenceStore(tmp_path)
    one, other = (store.load_frames(spec, SIZE, [4])[4] for spec in (SPEC, change_spec(**CHANGES[change])))
    assert one.digest != other.digest
    assert is_identical(ReferenceStore(tmp_path, Refuses()).load_frames(SPEC, SIZE, [4])[4], one)


def test_a_problem_that_the_same_scene_states_differently_now_is_prepared_again(tmp_path, monkeypatch):
    """As after a change of the code: the scene's digest is the same, its springs are not."""
    store = ReferenceStore(tmp_path)
    before = store.load_frames(SPEC, SIZE, [4])[4]
    monkeypatch.setitem(
        SPEC.__dict__, "effects", (SpringsEffect(stretch=120.0), *SPEC.effects[1:])
    )  # the digest is unchanged
    after = store.load_frames(SPEC, SIZE, [4])[4]
    assert after.digest != before.digest
    fresh = ReferenceStore(tmp_path / "fresh").load_frames(SPEC, SIZE, [4])[4]
    assert is_identical(after, fresh)


def test_a_reference_run_that_does_not_converge_is_no_reference(tmp_path):
    stiff = change_spec(effects=(SpringsEffect(stretch=1e9), *SPEC.effects[1:]))
    with pytest.raises(RunFailed, match="step 1 of the reference run does not converge"):
        ReferenceStore(tmp_path, SparseLocalGlobal()).load_snapshots(stiff, SIZE)


def test_complete_files_alone_are_left(tmp_path):
    store = ReferenceStore(tmp_path)
    for one in store.load_snapshots(SPEC, SIZE).values():
        store.find_minima(one)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    assert {path.name.split("-")[0] for path in tmp_path.iterdir()} == {"run", "snapshot", "minima"}
    for path in tmp_path.iterdir():
        with np.load(path, allow_pickle=False) as stored:
            assert all(stored[name].dtype.kind in "fiU" for name in stored)


def test_a_step_without_iterations_left_has_converged_if_its_gradient_is_round_off(monkeypatch):
    monkeypatch.setattr(step_snapshot, "REFERENCE_STOP_RULE", StopRule(1, 1e-12, roundoff_floor=0.0))
    scene, solver = build_exact_scene(SPEC, SIZE), NewtonSolver()
    with pytest.raises(RunFailed, match="step 1 of the reference run does not converge"):
        run_reference(scene, solver, 1)
    monkeypatch.setattr(step_snapshot, "_MAX_ROUNDOFF_RATIO", 1e30)
    assert set(run_reference(scene, solver, 1)[0]) == {1}
