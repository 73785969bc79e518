"""Augmented vertex block descent: exact lengths against closed forms, the very stiff limit and their own conditions."""

from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.reference.exact_lengths import ExactLengths
from springbench.harness.reference.residual_audit import AuditedSolver
from springbench.harness.reference.step_verifier import StepVerifier
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.strain_limits_effect import StrainLimitsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import NetMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.solver_contract import DelegatingSolver
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers import registry
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.vertex_block.avbd import AugmentedVertexBlockDescent as Avbd
from springbench.solvers.methods.vertex_block.avbd import PreparedAugmentedVertexBlockDescent
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.energies import spring_energy
from springbench.solvers.model.energies.augmented_lagrangian import concatenate_constraints, length_errors
from springbench.solvers.model.step_problem import LengthConstraints, Solution, StepProblem, StopRule, Unsupported

from tests.oracles.verify_scene import verify_terms
from tests.scene_builders import build_first_problem, build_test_scene

CONFIGS = Path(__file__).parents[2] / "configs" / "exact"
FIRST = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
EXACT = SpringsEffect.model_validate({"stretch": "exact", "scaling_rule": "fixed"})
DOWN = ChainMesh(direction=(0.0, -1.0, 0.0))
ROUND_OFF = 1e-9
"""Of metres and newtons of size one, after solves to a residual of 1e-11 of the step's."""


def chain(size: int, mesh: ChainMesh | None = None, *others: Any, **settings: Any) -> Scene:
    return build_test_scene(mesh or ChainMesh(), EXACT, GravityEffect(), FIRST, *others, size=size, **settings)


def heavier(stated: StepProblem, times: float) -> StepProblem:
    """The same chain whose last mass is multiplied by the ratio."""
    mass = stated.system.mass.copy()
    mass[-1] *= times
    force = stated.external_force * (mass / stated.system.mass)[:, None]
    return replace(stated, system=replace(stated.system, mass=mass), external_force=force)


def solve_step(stated: StepProblem, iterations: int = 20_000, tolerance: float = 1e-11, **settings: Any):
    prepared = Avbd(**settings).prepare(stated.system)
    return prepared.solve(stated, StopRule(iterations, tolerance))


def test_a_pendulum_ends_where_its_sphere_is_nearest_to_free_fall():
    """The step minimises |p - y|^2 on a sphere: p = r y/|y|, and the tension is m/dt^2 (|y| - r)."""
    stated = build_first_problem(chain(2, mass=1.0))
    m, dt = stated.system.mass[1], stated.system.time_step
    y = stated.inertial_target[1] + stated.external_force[1] * dt**2 / m - stated.current_positions[0]
    r = float(concatenate_constraints(stated.system.length_constraints).max_length[0])
    found = solve_step(stated)
    assert found.termination_reason == "converged"
    np.testing.assert_allclose(
        found.positions[1] - stated.current_positions[0], r * y / np.linalg.norm(y), atol=ROUND_OFF
    )
    assert found.warm_start is not None
    np.testing.assert_allclose(found.warm_start[0, 0], m / dt**2 * (np.linalg.norm(y) - r), rtol=1e-6)


@pytest.mark.parametrize("heavy", [1.0, 1e4])
def test_a_chain_at_rest_carries_what_hangs_below(heavy):
    """Least squares find the tensions at rest, whatever the ratio of masses, and so does the method."""
    stated = heavier(build_first_problem(chain(9, DOWN, mass=1.0)), heavy)
    weight = 9.81 * np.cumsum(stated.system.mass[:0:-1])[::-1]
    np.testing.assert_allclose(
        ExactLengths(stated.system).compute_tensions(stated, stated.current_positions), weight, rtol=1e-6
    )
    found = solve_step(stated)
    np.testing.assert_allclose(found.positions, stated.current_positions, atol=1e-6)
    assert found.warm_start is not None
    np.testing.assert_allclose(found.warm_start[:, 0], weight, rtol=1e-3)


def test_a_swinging_chain_is_the_limit_of_stiff_ones():
    """Springs of k differ from exact ones by their stretch, t/k, along the whole chain."""
    bound = chain(9, mass=1.0)
    steps = [step.positions for step in simulate_scene(bound, prepare(bound, Avbd()), StopRule(20_000, 1e-10),
                                                 initial_guess="previous", frames=6)]  # fmt: skip
    away = []
    for k in (1e6, 1e7):
        stiff = build_test_scene(
            ChainMesh(), SpringsEffect(stretch=k, scaling_rule="fixed"), GravityEffect(), FIRST, size=9
        )
        run = simulate_scene(stiff, prepare(stiff, NewtonSolver()), StopRule(200), initial_guess="previous", frames=6)
        away.append(max(np.abs(step.positions - p).max() for step, p in zip(run, steps, strict=True)))
    assert away[0] < 1e-4
    assert away[1] < 0.2 * away[0]  # a tenth, if both are converged


def build_limited_net() -> Scene:
    """A net that hangs by its corners, so soft that most of what would be its sag is beyond its limits."""
    corners = PinsEffect.model_validate({"parts": ["corners"], "weight": "exact"})
    limits = StrainLimitsEffect.model_validate({"stiffness": "exact", "max_stretch": 1.05})
    return build_test_scene(
        NetMesh(), SpringsEffect(stretch=5.0, scaling_rule="fixed"), limits, GravityEffect(), corners, size=5, mass=1.0
    )


def test_exact_limits_are_satisfied_and_pull_only_where_they_are_reached():
    bound = build_limited_net()
    lengths, slack = concatenate_constraints(bound.system.length_constraints), np.empty(0)
    for step in simulate_scene(
        bound, prepare(bound, Avbd()), StopRule(20_000, 1e-9), initial_guess="previous", frames=8
    ):
        assert step.solution.warm_start is not None
        tension, out = step.solution.warm_start[:, 0], length_errors(lengths, step.positions)
        assert np.abs(out / lengths.max_length).max() < 1e-6
        length = np.linalg.norm(np.diff(step.positions[lengths.edges], axis=1)[:, 0], axis=1)
        slack = length < lengths.max_length * (1.0 - 1e-6)
        assert (tension[slack] == 0.0).all()
        assert (tension >= 0.0).all()
    assert not slack.all()


@pytest.mark.parametrize("bound", [chain(9, mass=1.0), build_limited_net()], ids=["chain", "limits"])
def test_the_verifier_finds_a_minimum_at_the_solution_and_nowhere_else(bound):
    stated = build_first_problem(bound)
    judge, p = StepVerifier(bound, None, is_minimiser=True), solve_step(stated).positions
    assert judge.measure_stationarity(stated, p).above_roundoff < 1e-7
    assert judge.measure_curvature(stated, p).is_convex
    moved = p.copy()
    moved[stated.system.free_vertices[-1]] += 1e-3
    assert judge.measure_stationarity(stated, moved).above_roundoff > 1e-3


def test_the_farthest_point_of_a_sphere_is_stationary_and_no_minimum():
    stated = build_first_problem(chain(2, mass=1.0))
    p = solve_step(stated).positions
    p[1] = 2.0 * p[0] - p[1]
    judge = StepVerifier(chain(2, mass=1.0), None, is_minimiser=True)
    assert judge.measure_stationarity(stated, p).above_roundoff < 1e-7
    assert not judge.measure_curvature(stated, p).is_convex


def test_where_nothing_is_exact_it_is_vertex_block_descent():
    stated = build_first_problem(build_test_scene(NetMesh(), SpringsEffect(stretch=300.0), GravityEffect(), size=5))
    both = (
        (p.copy() for p in islice(m.prepare(stated.system).iterates(stated), 5)) for m in (Avbd(), VertexBlockDescent())
    )
    for one, other in zip(*both, strict=True):
        np.testing.assert_array_equal(one, other)


def test_softened_springs_end_at_the_minimum():
    """However soft they begin: every second one is a hundred times as stiff as the others."""
    stated = build_first_problem(
        build_test_scene(DOWN, SpringsEffect(stretch=100.0, scaling_rule="fixed"), GravityEffect(), FIRST, size=9)
    )
    (found,) = stated.system.energies
    assert isinstance(found, spring_energy.Springs)
    ratio = replace(found, stiffness=np.where(np.arange(8) % 2, 100.0, 1.0) * found.stiffness)
    stated = replace(stated, system=replace(stated.system, energies=(ratio,)))
    end = NewtonSolver().prepare(stated.system).solve(stated, StopRule(200)).positions
    assert np.abs(end - solve_step(stated, ramp_spring_stiffness=True, stiffness_ramp=1e6).positions).max() < 1e-6


CLAIMS = {
    "three links": lambda: chain(4, mass=1.0),
    "nine links": lambda: chain(10, mass=1.0),
    "limits": build_limited_net,
}


@pytest.mark.parametrize("case", CLAIMS)
def test_a_step_that_ends_by_its_tolerance_has_no_more_of_the_gradient_left(case):
    """By the tensions that are best at its end, which the method need not have reached yet."""
    bound = CLAIMS[case]()
    judge = StepVerifier(bound, None, is_minimiser=True)
    for step in simulate_scene(
        bound, prepare(bound, Avbd()), StopRule(20_000, 1e-6), initial_guess="previous", frames=6
    ):
        reached = judge.measure_stationarity(step.problem, step.solution.positions).stationarity
        assert step.solution.termination_reason == "converged"
        assert reached <= 1.01e-6
        np.testing.assert_allclose(
            step.solution.residual / step.solution.initial_residual, reached, rtol=1e-3, atol=1e-12
        )


def test_a_residual_without_a_tolerance_is_that_of_the_step_too():
    bound = chain(9, mass=1.0)
    stated = build_first_problem(bound)
    found = Avbd().prepare(stated.system).solve(stated, StopRule(40))
    judge = StepVerifier(bound, None, is_minimiser=True)
    reading, scale = judge.measure_stationarity(stated, found.positions), solve_step(stated).initial_residual
    np.testing.assert_allclose(found.residual, reading.stationarity * scale, rtol=1e-6)


def test_multipliers_of_a_hanging_chain_are_what_hangs_below():
    """At rest they are found by hand; a length that is off by e in addition requires its stiffness times e."""
    stated = build_first_problem(chain(4, DOWN, mass=1.0))
    made = Avbd().prepare(stated.system)
    assert isinstance(made, PreparedAugmentedVertexBlockDescent)
    weight = 9.81 * np.cumsum(stated.system.mass[:0:-1])[::-1]
    np.testing.assert_allclose(
        made.least_squares_multipliers.multipliers_at(stated, stated.current_positions), weight, rtol=1e-9
    )


def test_multipliers_of_limits_pull_where_a_limit_is_active_and_nowhere_else():
    """One vertex between two pins, pulled along the line to beyond one limit: that edge pulls, the other is slack."""
    ends = PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"})
    limits = StrainLimitsEffect.model_validate({"stiffness": "exact", "max_stretch": 1.05})
    stated = build_first_problem(
        build_test_scene(
            ChainMesh(length=2.0), SpringsEffect(stretch=1.0, scaling_rule="fixed"), limits, ends, size=3, mass=3.0
        )
    )
    m, dt = stated.system.mass[1], stated.system.time_step
    p, target = stated.current_positions.copy(), stated.current_positions.copy()
    p[1, 0] += 0.05
    target[1, 0] += 0.05 + 4.0 * dt**2 / m
    stated = replace(stated, inertial_target=target)
    made = Avbd().prepare(stated.system)
    assert isinstance(made, PreparedAugmentedVertexBlockDescent)
    found = made.least_squares_multipliers.multipliers_at(stated, p)
    np.testing.assert_allclose(found, [4.0 - 2.0 * 0.05, 0.0], atol=1e-9)  # less what both springs take of it


@pytest.mark.parametrize("stabilisation", [0.0, 0.25, 1.0])
def test_a_stabilised_step_leaves_that_fraction_of_the_initial_error(stabilisation):
    """A link of 1 m that begins 0.1 m too long ends at 1 m and that part of 0.1 m."""
    stated = build_first_problem(chain(2, mass=1.0))
    begun = stated.step_start.positions.copy()
    begun[1] = begun[0] + 1.1 * (begun[1] - begun[0])
    stated = replace(stated, step_start=replace(stated.step_start, positions=begun))
    found = Avbd(error_stabilisation=stabilisation).prepare(stated.system).solve(stated, StopRule(2000))
    (away,) = length_errors(concatenate_constraints(stated.system.length_constraints), found.positions)
    np.testing.assert_allclose(away, stabilisation * 0.1, atol=1e-9)


class _Claiming(DelegatingSolver):
    """Says of its answers that a part of the residual is left."""

    def __init__(self, prepared, part: float) -> None:
        super().__init__(prepared)
        self._part = part

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        found = self._prepared.solve(problem, stop)
        return replace(
            found,
            residual=self._part * found.residual,
            termination_reason="converged" if stop.rtol else found.termination_reason,
        )


def test_a_false_residual_of_exact_lengths_is_found():
    """One that is a hundred times too small, and an early end by a tolerance that was not reached."""
    stated = build_first_problem(chain(4, mass=1.0))
    made = Avbd().prepare(stated.system)
    for part, stop, said in (
        (1.0, StopRule(8), ""),
        (0.01, StopRule(8), "expected"),
        (1.0, StopRule(8, 1e-6), "tolerance"),
    ):
        graded = AuditedSolver(_Claiming(made, part), Avbd(), {1})
        if said:
            with pytest.raises(RunFailed, match=said):
                graded.solve(stated, stop)
        else:
            graded.solve(stated, stop)
            assert graded.found[1]["stationarity_audit"] > 0.0


HARD = {
    "no pins": lambda: build_first_problem(build_test_scene(NetMesh(), EXACT, GravityEffect(), size=4)),
    "lengths that follow from others": lambda: _doubled(build_first_problem(chain(5, mass=1.0)), 3),
    "all in one point": lambda: _at(build_first_problem(chain(5, mass=1.0)), 0.0),
    "a last vertex 10,000 times as heavy": lambda: heavier(build_first_problem(chain(17, mass=1.0)), 1e4),
}


def _doubled(stated: StepProblem, times: int) -> StepProblem:
    return replace(stated, system=replace(stated.system, length_constraints=stated.system.length_constraints * times))


def _at(stated: StepProblem, part: float) -> StepProblem:
    """The same from a shape that has so much of its size."""
    first = stated.current_positions[0]
    return replace(stated, initial_guess=first + part * (stated.current_positions - first))


@pytest.mark.parametrize("case", HARD)
def test_hard_cases_preserve_exact_lengths(case):
    stated = HARD[case]()
    found = solve_step(stated, 50_000, 1e-9)
    lengths = concatenate_constraints(stated.system.length_constraints)
    assert np.abs(length_errors(lengths, found.positions) / lengths.max_length).max() < 1e-6


def test_lengths_that_cannot_all_be_satisfied_are_reported():
    """A chain of 1 m between pins that are 2 m apart: tensions stay bounded, all links give, a metre in all."""
    stated = build_first_problem(
        build_test_scene(ChainMesh(), EXACT, PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"}), size=5)
    )
    far = stated.pin_targets.copy()
    far[1] = far[0] + 2.0 * (far[1] - far[0])
    stated = replace(stated, pin_targets=far)
    found = solve_step(stated, 5000)
    assert found.termination_reason == "max-iter"
    away = length_errors(concatenate_constraints(stated.system.length_constraints), found.positions)
    assert (away > 0.0).all()
    np.testing.assert_allclose(away.sum(), 1.0, rtol=1e-6)


@pytest.mark.parametrize("name", [name for name in registry.SOLVERS if name != "avbd"])
def test_every_other_solver_refuses_exact_lengths_by_name(name):
    solver = registry.load_target(registry.SOLVERS[name])()
    with pytest.raises(Unsupported, match=f"^{name}: .*exact.*avbd"):
        prepare(chain(3, mass=1.0), solver)


def test_a_solver_prepared_without_the_harness_is_refused_too():
    stated = build_first_problem(chain(3, mass=1.0))
    with pytest.raises(Unsupported, match="exact"):
        NewtonSolver().prepare(stated.system).solve(stated, StopRule(1))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"stiffness_ramp": -1.0}, "stiffness_ramp"),
        ({"max_stiffness_ratio": 0.5}, "max_stiffness_ratio"),
        ({"warm_start_decay": 1.5}, "warm_start_decay"),
        ({"error_stabilisation": 2.0}, "error_stabilisation"),
        ({"spectral_radius": 1.0}, "spectral_radius"),
    ],
)
def test_invalid_settings_are_named(settings, said):
    with pytest.raises(ValueError, match=f"^{said}: should be"):
        Avbd(**settings)


def test_a_length_that_is_no_length_cannot_be_exact():
    mesh = build_test_scene(ChainMesh(), GravityEffect(), size=3).mesh
    flat = replace(mesh, rest_positions=np.zeros_like(mesh.rest_positions))
    with pytest.raises(InputError, match="spring 0-1 has no length"):
        EXACT.build_contribution(flat, np.ones(3), 0.1)


@pytest.mark.parametrize("name", ["cloth", "limits", "pendulum"])
def test_the_reference_terms_have_the_exact_lengths(name):
    spec = load_scene(CONFIGS / f"{name}.yaml")
    bound = build_scene(spec, 5)
    assert verify_terms(spec, bound, "implicit-euler") == "agrees"
    (one,) = bound.system.length_constraints
    longer = replace(one, max_length=one.max_length * np.where(np.arange(len(one.max_length)) == 1, 1.01, 1.0))
    lying = replace(bound, system=replace(bound.system, length_constraints=(longer,)))
    assert "exact lengths" in verify_terms(spec, lying, "implicit-euler")


def test_lengths_are_exact_at_a_steps_end_and_integrators_of_other_unknowns_are_refused():
    bound = chain(3, mass=1.0)
    assert isinstance(bound.system.length_constraints[0], LengthConstraints)
    spec = SceneSpec(mesh=ChainMesh(), mass=1.0, time_step=0.1, frames=1, effects=(EXACT,), path=Path("scene.yaml"))
    with pytest.raises(InputError, match="take implicit-euler or bdf2"):
        build_scene(spec, 3, "midpoint")
