"""Runs to an error: the ladder of steps, the growth of perturbations, the choice, invalid requests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.experiments.error_control.candidate_methods import (
    ErrorTarget,
    list_candidate_methods,
    prepare_candidate_methods,
)
from springbench.harness.experiments.error_control.method_search import (
    compute_predictability_horizon,
    search_cheapest_method,
)
from springbench.harness.experiments.error_control.third_party_integrators import build_jacobian_sparsity
from springbench.harness.reference.equations_of_motion import OdeField, build_ode_scene
from springbench.harness.reference.perturbation_growth import estimate_growth
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.reference_trajectory import (
    CHECK_PERTURBATION,
    INTEGRATION_RTOL,
    UnpredictableMotion,
    _integrate_dop853,
    integrate_motion,
)
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.adaptive_stepping import (
    AdaptiveImplicitStepper,
    StepSizeUnderflow,
    interpolate_hermite,
)
from springbench.harness.simulation.substepping import AdaptiveSubstepper, FixedSubstepper
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.time_stepping.explicit_integrators import Tsitouras5, VelocityVerlet
from springbench.solvers.methods.time_stepping.rosenbrock import Rodas
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import StopRule

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
FIRST_PIN = PinsEffect(parts=("first",), weight="exact")
MOVING_PIN = PinsEffect.model_validate(
    {
        "parts": ["first"],
        "weight": "exact",
        "motion": {"key_frames": [{"time": 0.0}, {"time": 1.0, "offset": [0.5, 1.0, 0.0]}]},
    }
)
END, FRAMES = 0.5, 10
OWN = ["velocity-verlet", "blanes-moan-4", "blanes-moan-6", "tsitouras-5", "dormand-prince-8", "rodas"]
"""What is tried of the methods with steps of their own."""


def chain(*effects: Any, size: int = 5) -> SceneSpec:
    """Of 1 kg, thrown."""
    given = {"mesh": ChainMesh(), "effects": effects, "velocity": (0.5, 1.0, 2.0), "time_step": END / FRAMES}
    return SceneSpec(mass=1.0, frames=FRAMES, path=Path("scene.yaml"), default_size=size, **given)


def implicit(spec: SceneSpec, integrator: str, forces: tuple[Any, ...] = ()) -> AdaptiveImplicitStepper:
    def build_scene_at(h: float) -> Scene:
        return replace(build_scene(spec.with_time_step(h), 5, integrator), varying_forces=forces)

    return AdaptiveImplicitStepper(build_scene_at, NewtonSolver(), END, FRAMES)


SWINGING = chain(SpringsEffect(stretch=40.0), GravityEffect(), FIRST_PIN)


@pytest.mark.parametrize("integrator", ["tr-bdf2", "esdirk-3", "esdirk-4", "sdirk-4"])
def test_a_closer_tolerance_gives_a_smaller_error_by_more_steps_and_few_factors(integrator):
    truth = integrate_motion(build_scene(SWINGING, 5, "substepping"), [END])
    paths = [implicit(SWINGING, integrator).integrate_motion(tolerance) for tolerance in (1e-3, 1e-6)]
    coarse, fine = (truth.measure_error(0, path.positions[-1]) for path in paths)
    assert fine < 0.1 * coarse  # a thousandth to the power 3/4 or 2/3 is a hundredth, steps being halves
    assert fine < 1e-3
    for path in paths:
        assert path.positions.shape == (FRAMES + 1, 5, 3)
        assert (
            path.num_factorisations
            <= 1 + np.log2(path.step_size_range[1] / path.step_size_range[0]) + path.num_rejected_steps
        )
        assert path.num_accepted_steps >= END / path.step_size_range[1]


def test_a_tolerance_is_changed_by_the_order_of_a_step():
    """Errors of steps are of order h^(k + 1), those of the end of h^k."""
    way = implicit(SWINGING, "esdirk-4")
    assert way.scale_setting(1e-3, 0.1) == pytest.approx(10.0**-4.25)
    assert way.scale_setting(1e-3, 0.1, 1.0) == pytest.approx(1e-5)


def test_frames_are_on_the_motion_though_steps_are_longer_than_they_are():
    path = implicit(SWINGING, "esdirk-4").integrate_motion(3e-4)
    assert path.step_size_range[1] > END / FRAMES
    truth = integrate_motion(build_scene(SWINGING, 5, "substepping"), list(np.linspace(0.0, END, FRAMES + 1)[1:]))
    away = np.abs(path.positions[1:] - truth.positions).max()
    assert away < 0.03 * np.abs(truth.positions[-1] - path.positions[0]).max()  # h^4/384 of a cubic, and its tolerance


def test_steps_grow_again_after_what_made_them_short():
    """Dashpots stop the throw within a thousandth of a second; what is left is slow."""
    path = implicit(
        chain(SpringsEffect(stretch=40.0), DashpotsEffect(stretch=100.0), GravityEffect(), FIRST_PIN), "esdirk-4"
    ).integrate_motion(1e-5)
    assert path.step_size_range[1] >= 16 * path.step_size_range[0]
    assert path.num_accepted_steps < 100


def test_the_same_motion_has_the_same_bits():
    one, two = (implicit(SWINGING, "esdirk-4").integrate_motion(1e-5) for _ in "ab")
    np.testing.assert_array_equal(one.positions, two.positions)


def test_a_step_below_the_floor_ends_with_the_frame_the_cause_and_what_was_reached():
    def breaks(p: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        return np.full_like(p, np.nan if t > 0.22 else 0.0)

    with pytest.raises(
        StepSizeUnderflow,
        match=r"frame 5, after 0\.2\d+ s: even a step of .* not solved; up to there \d+ steps were within",
    ):
        implicit(chain(SpringsEffect(stretch=40.0), FIRST_PIN), "esdirk-4", (breaks,)).integrate_motion(1e-3)


def test_hermites_cubic_is_exact_for_cubics():
    rng = np.random.default_rng(3)
    c = rng.normal(size=(4, 2, 3))

    def at(t: float) -> Motion:
        return Motion(c[0] + t * (c[1] + t * (c[2] + t * c[3])), c[1] + t * (2.0 * c[2] + 3.0 * t * c[3]))

    found = interpolate_hermite(at(0.5), at(2.0), 1.5, 0.3)
    # Some roundings of numbers near 10.
    np.testing.assert_allclose(found.positions, at(0.95).positions, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.velocity, at(0.95).velocity, rtol=0, atol=1e-13)


@pytest.mark.parametrize("error", [1e-2, 1e-3, 1e-4])
@pytest.mark.parametrize(("scene", "size", "horizon"), [("single-spring", 2, 1.0), ("chain", 5, 0.5)])
def test_the_error_is_never_above_the_requested_one_whichever_method_wins(scene, size, horizon, error, monkeypatch):
    error_target = ErrorTarget.from_scene(load_scene(SCENES / f"{scene}.yaml"), size, horizon)
    messages = list[str]()
    seen, truth = (
        compute_predictability_horizon(error_target, error, messages.append),
        integrate_motion(error_target.build_scene(error_target.frame_seconds, "substepping"), [horizon]),
    )
    for way in prepare_candidate_methods(error_target, messages.append):
        monkeypatch.setattr(
            "springbench.harness.experiments.error_control.method_search.prepare_candidate_methods",
            lambda *_, way=way: [way],
        )
        found = search_cheapest_method(error_target, error, seen, messages.append).best_trial
        true = truth.measure_error(0, found.trajectory.positions[-1])
        assert true <= found.error_estimated <= error, found.method
        # The doubt, and the closer tolerance, which no estimate is below.
        assert found.error_estimated <= 1.5 * true + 0.02 * error, found.method
    assert any("an error of" in line for line in messages)


def steps_of(spec: SceneSpec, size: int) -> list[Any]:
    scene = build_scene(spec, size, "substepping")
    return [*simulate_scene(scene, prepare(scene, VelocityVerlet()), StopRule(1), initial_guess="previous", frames=10)]


def integrate_perturbation(spec: SceneSpec, size: int, times: list[float]) -> np.ndarray:
    """What 1e-12 of the size at the start becomes, relative to the displacement, by the reference's own method."""
    field = OdeField(build_ode_scene(spec, size))
    begun, half, length = (
        field.initial_state,
        len(field.initial_state) // 2,
        build_scene(spec, size).mesh.bounding_box_diagonal or 1.0,
    )
    nudge = np.zeros_like(begun)
    nudge[:half] = CHECK_PERTURBATION * length * np.random.default_rng(0).choice([-1.0, 1.0], half)
    one, two = (_integrate_dop853(field, y, times, INTEGRATION_RTOL * length) for y in (begun, begun + nudge))
    return np.linalg.norm((two - one)[:, :half], axis=1) / np.linalg.norm((one - begun)[:, :half], axis=1)


CRUMPLING = SceneSpec(
    mesh=GridMesh(),
    effects=(
        SpringsEffect(stretch=300.0, shear=60.0),
        GravityEffect(),
        PinsEffect(parts=("top_corners",), weight="exact"),
    ),
    mass=0.3, time_step=1 / 30, frames=60, path=Path("cloth.yaml"), default_size=9,
)  # fmt: skip


@pytest.mark.parametrize(
    ("spec", "size", "end"),
    [
        (CRUMPLING, 7, 1.0),
        (
            chain(
                SpringsEffect(stretch=40.0),
                GravityEffect(),
                AirDragEffect(drag_law="quadratic", coefficient=0.5),
                FIRST_PIN,
            ),
            5,
            0.5,
        ),
        (chain(SpringsEffect(stretch=40.0), GravityEffect(), MOVING_PIN), 5, 0.3),
    ],
    ids=["crumpling", "drag", "moving pin"],
)
def test_the_estimated_growth_is_that_of_perturbed_integrations(spec, size, end):
    found = estimate_growth(spec, size, end)
    times = [float(t) for t in found.times[5::10]]
    np.testing.assert_allclose(
        found.interpolate_growth(times), integrate_perturbation(spec, size, times), rtol=0.5
    )  # over some orders of magnitude


def test_growth_does_not_depend_on_the_time_step_and_ends_where_nothing_is_predictable():
    one, other = (estimate_growth(CRUMPLING.with_time_step(h), 9, 3.0) for h in (1 / 30, 1 / 240))
    np.testing.assert_array_equal(one.growth_factor, other.growth_factor)
    assert one.growth_factor[-1] == 1.0
    assert (np.diff(one.growth_factor >= 1.0) >= 0).all()


def test_a_refusal_names_the_longest_horizon_that_works(tmp_path):
    error_target, error = ErrorTarget.from_scene(CRUMPLING, 7, 1.6), 1e-7
    with pytest.raises(UnpredictableMotion, match=r"after 1.6 s .* a --t-end of [\d.]+ s or less") as refused:
        compute_predictability_horizon(error_target, error, lambda line: None)
    horizon = float(str(refused.value).rpartition("--t-end of ")[2].split()[0])
    assert 0.3 < horizon < 1.6
    compute_predictability_horizon(ErrorTarget.from_scene(CRUMPLING, 7, horizon), error, lambda line: None)
    store = ReferenceStore(tmp_path)
    assert store.load_trajectory(CRUMPLING, 7, [horizon], error=error).growth[0] <= 0.1 * error
    with pytest.raises(UnpredictableMotion, match=f"a --t-end of {horizon:g} s or less"):
        store.load_trajectory(CRUMPLING, 7, [1.6], error=error)


def test_long_steps_that_an_error_allows_cause_no_warning(caplog: pytest.LogCaptureFixture):
    error_target = ErrorTarget.from_scene(SWINGING, 5, 40.0)
    with caplog.at_level("WARNING", logger="springbench"):
        error_target.build_scene(20.0, "esdirk-4")
        assert not caplog.records
        build_scene(SWINGING.with_time_step(20.0), 5)
        assert "a time step of 20 s is long" in caplog.text, "as it is of steps that somebody states"


def test_an_error_below_round_off_is_refused_with_the_attainable_one():
    pendulum = ErrorTarget.from_scene(load_scene(SCENES / "single-spring.yaml"), 2, 1.0)
    assert (
        estimate_growth(pendulum.scene, 2, 1.0).min_error < 1e-9
    )  # 1e-12 of the size grows with the time, and no faster
    with pytest.raises(UnpredictableMotion, match=r"error of 1e-14 cannot .*; use an --error of \de-1[0-2] or more"):
        compute_predictability_horizon(pendulum, 1e-14, lambda line: None)


def test_what_only_round_off_moves_is_at_rest(tmp_path):
    """A flat cloth without a load, pinned at its corners."""
    spec = CRUMPLING.model_copy(
        update={"effects": (SpringsEffect(stretch=10.0), PinsEffect(parts=("corners",), weight="exact"))}
    )
    assert len({step.positions.tobytes() for step in steps_of(spec, 5)}) > 1, "round-off does move it"
    for ask in (
        lambda: compute_predictability_horizon(ErrorTarget.from_scene(spec, 5, 1.0), 1e-3, lambda line: None),
        lambda: ReferenceStore(tmp_path).load_trajectory(spec, 5, [1.0], error=1e-3),
    ):
        with pytest.raises(UnpredictableMotion, match="nothing moves up to the horizon"):
            ask()


def test_the_pattern_of_the_jacobian_contains_all_nonzeros():
    scene = build_scene(
        chain(SpringsEffect(stretch=40.0), DashpotsEffect(stretch=1.0), GravityEffect(), FIRST_PIN), 5, "newmark"
    )
    field = OdeField(scene)
    y, found = (
        field.initial_state + 0.1 * np.random.default_rng(2).normal(size=24),
        build_jacobian_sparsity(scene).toarray() > 0,
    )
    changes = np.array([field(0.0, y + step) - field(0.0, y) for step in 1e-4 * np.eye(24)]).T
    assert (found | (np.abs(changes) < 1e-14)).all()  # round-off of forces of some newtons
    assert not found.all()


def test_candidate_methods_follow_from_the_properties_of_solvers_and_integrators():
    assert {(integrator, solver.name) for integrator, solver in list_candidate_methods()} == {
        *((integrator, solver) for solver in ("lbfgs", "newton") for integrator in ("esdirk-4", "midpoint")),
        *(("substepping", solver) for solver in OWN),
    }


@pytest.mark.parametrize(
    ("effect", "what"),
    [
        (MOVING_PIN, "moving pins"),
        (AirDragEffect(drag_law="quadratic", coefficient=0.5), "forces that depend on position, velocity or time"),
    ],
)
def test_methods_that_would_lose_their_order_silently_are_named_with_the_reason(effect, what):
    fixed = () if effect is MOVING_PIN else (FIRST_PIN,)
    messages, error_target = list[str](), ErrorTarget(chain(SpringsEffect(stretch=40.0), effect, *fixed), 5, 0.1, 2)
    found = prepare_candidate_methods(error_target, messages.append)
    assert {way.solver: way.stepper.order for way in found if way.integrator == "substepping"} == dict.fromkeys(
        OWN[:3], 1
    )
    assert {way.integrator for way in found} == {"substepping", "esdirk-4", "midpoint"}
    assert [line.removeprefix("  unsupported: ").split(":")[0] for line in messages] == OWN[3:]
    assert all(what in line for line in messages)


def test_fixed_steps_are_no_longer_than_is_stable_and_as_short_as_the_error_requires():
    """Of order 2: the step for a hundredth of the error is a tenth."""
    even, truth = (
        FixedSubstepper(
            build_scene(SWINGING, 5, "substepping"),
            VelocityVerlet(),
            FRAMES,
            lambda h: build_scene(SWINGING.with_time_step(h), 5, "substepping"),
        ),
        integrate_motion(build_scene(SWINGING, 5, "substepping"), [END]),
    )
    assert even.initial_setting(1e-3) == even.scale_setting(1.0, 100.0) == 1.0
    assert even.scale_setting(4.0, 0.01) == pytest.approx(40.0)
    coarse, fine = (even.integrate_motion(setting) for setting in (4.0, even.scale_setting(4.0, 0.01)))
    assert fine.num_accepted_steps == pytest.approx(
        10 * coarse.num_accepted_steps, rel=0.1
    )  # whole numbers of steps in a frame
    errors = [truth.measure_error(0, path.positions[-1]) for path in (coarse, fine)]
    assert errors[1] == pytest.approx(0.01 * errors[0], rel=0.2)


@pytest.mark.parametrize("solver", [VelocityVerlet(), Tsitouras5()], ids=["velocity-verlet", "tsitouras-5"])
def test_frames_that_are_integrated_together_are_those_of_an_observed_motion(solver):
    scene, seen = build_scene(SWINGING, 5, "substepping"), list[Motion]()
    stepper = (
        FixedSubstepper(scene, solver, FRAMES, lambda h: build_scene(SWINGING.with_time_step(h), 5, "substepping"))
        if isinstance(solver, VelocityVerlet)
        else AdaptiveSubstepper(scene, solver, FRAMES)
    )
    setting = stepper.initial_setting(1e-5)
    path = stepper.integrate_motion(setting)
    stepper.integrate_motion(setting, observe=lambda scene, step, time: seen.append(step.state.motion))
    np.testing.assert_array_equal(path.positions[1:], [motion.positions for motion in seen])
    np.testing.assert_array_equal(path.velocities[1:], [motion.velocity for motion in seen])
    assert sum(path.frame_seconds) == pytest.approx(path.wall_seconds)


def test_forces_of_the_speed_are_constant_within_parts_of_a_frame_as_short_as_the_error_requires():
    spec = chain(SpringsEffect(stretch=40.0), AirDragEffect(drag_law="quadratic", coefficient=0.5), FIRST_PIN)
    even = FixedSubstepper(
        build_scene(spec, 5, "substepping"),
        VelocityVerlet(),
        FRAMES,
        lambda h: build_scene(spec.with_time_step(h), 5, "substepping"),
    )
    truth = integrate_motion(build_scene(spec, 5, "substepping"), [END])
    assert even.scale_setting(2.0, 0.25) == 8.0
    coarse, fine = (even.integrate_motion(setting) for setting in (2.0, 16.0))
    assert coarse.positions.shape == fine.positions.shape == (FRAMES + 1, 5, 3)
    errors = [truth.measure_error(0, path.positions[-1]) for path in (coarse, fine)]
    assert errors[1] < errors[0] / 7  # an eighth of what is of order 1, less of what the substeps leave


def test_a_rosenbrock_method_meets_a_requested_error():
    truth = integrate_motion(build_scene(SWINGING, 5, "substepping"), [END])
    scene = build_scene(SWINGING, 5, "substepping")
    coarse, fine = (
        AdaptiveSubstepper(scene, Rodas(), FRAMES).integrate_motion(tolerance) for tolerance in (1e-3, 1e-6)
    )
    assert fine.num_accepted_steps > coarse.num_accepted_steps
    assert [path.num_factorisations for path in (coarse, fine)] == [
        p.num_accepted_steps + p.num_rejected_steps for p in (coarse, fine)
    ]
    assert truth.measure_error(0, fine.positions[-1]) < 0.1 * truth.measure_error(0, coarse.positions[-1])


def test_drag_that_grows_with_the_square_of_the_speed_is_graded_too(tmp_path):
    """As a force: where frames split, it is a filter, which has no equation of motion."""
    spec = chain(SpringsEffect(stretch=40.0), AirDragEffect(drag_law="quadratic", coefficient=0.5), FIRST_PIN)
    found = ReferenceStore(tmp_path).load_trajectory(spec, 5, [0.1], error=1e-3)
    error_target = ErrorTarget(spec, 5, 0.1, 2)
    path = AdaptiveImplicitStepper(
        lambda h: error_target.build_scene(h, "esdirk-4"), NewtonSolver(), error_target.t_end, error_target.num_frames
    ).integrate_motion(1e-6)
    assert found.measure_error(0, path.positions[-1]) < 1e-3
