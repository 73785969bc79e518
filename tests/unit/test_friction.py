"""Friction against Coulomb's law in closed form: thresholds, slides, creep and refinement, for every solver."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.network_mesh import NetworkMesh
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.harness.scenes.primitive_obstacles import PlaneObstacle
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.surface_obstacles import MeshObstacle, TriangleSurface
from springbench.harness.simulation.instrumentation_pass import build_solution_columns
from springbench.harness.simulation.time_loop import (
    MotionState,
    SimulationStep,
    build_initial_state,
    build_problem,
    prepare,
    simulate_scene,
)
from springbench.solvers.contact.lagged_friction import solve_with_friction
from springbench.solvers.contact.potentials.friction_law import evaluate_friction
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solution, Solver, StepProblem, StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.effect_scenes import with_integrator
from tests.scene_builders import build_test_scene
from tests.self_contact_scenes import SURFACE_CONTACT_SOLVERS

G, SLOPE = 9.81, 0.5
SIN, COS = SLOPE / np.hypot(1.0, SLOPE), 1.0 / np.hypot(1.0, SLOPE)
DOWN = GravityEffect(acceleration=(G * SIN, -G * COS, 0.0))
"""The frame is the slope's: gravity leans instead."""

STICKS, SLIPS = 0.6, 0.4
"""Coefficients on either side of the slope's tangent."""

THICKNESS, EXACTLY = 0.005, StopRule(400, 1e-10)
TAKE = ("sparse", "numba", "anderson", "chebyshev", "lbfgs", "vbd", "avbd", "hybrid", "newton", "newton-cg")
"""The solvers that support contact with half-spaces."""


def pebble(friction: float, dt: float = 1 / 60, integrator: str = "implicit-euler", **more: Any) -> Scene:
    """A vertex of 1 kg at rest on a slope, just not pressed."""
    ground = {"obstacles": [{"kind": "plane", "point": (0.0, -THICKNESS, 0.0)}], "min_distance": THICKNESS}
    rough = ContactEffect.model_validate(ground | {"friction": friction} | more)
    return with_integrator(
        build_test_scene(NetworkMesh(positions=((0.0, 0.0, 0.0),)), DOWN, rough, size=0, time_step=dt), integrator
    )


SURFACES: dict[str, Any] = {
    "plane": PlaneObstacle(point=(0.0, -0.0186, 0.0)),
    "mesh": MeshObstacle(
        mesh=TriangleSurface(points=((-4.0, 0.0, -4.0), (-4.0, 0.0, 8.0), (8.0, 0.0, -4.0)), triangles=((0, 1, 2),)),
        offset=(0.0, -0.0186, 0.0),
    ),
}
"""A plane is two triangles, and the patch lies on their common side: some normals there lean a little."""


def patch(
    friction: float, surface: Any = SURFACES["mesh"], down: GravityEffect = DOWN, integrator: str = "implicit-euler"
) -> Scene:
    """A small sheet in the range of a slope's barrier."""
    rough = SurfaceContactEffect(min_distance=0.01, friction=friction, barrier_stiffness=1000.0, obstacles=(surface,))
    springs = SpringsEffect(stretch=100.0, shear=20.0)
    made = build_test_scene(GridMesh(width=0.2, height=0.2), springs, down, rough, size=2, time_step=1 / 60)
    return with_integrator(made, integrator)


@cache
def build_pressed_state() -> MotionState:
    """The sheet at rest where the slope carries it."""
    made = patch(0.0, down=GravityEffect(acceleration=(0.0, -G * COS, 0.0)))
    last = steps(made, 60)[-1].state.motion
    assert np.abs(last.velocity).max() < 1e-4
    return MotionState(Motion(last.positions, np.zeros_like(last.positions)), None, 0)


def steps(
    made: Scene, frames: int, solver: Solver | None = None, stop: StopRule = EXACTLY, state: MotionState | None = None
) -> list[SimulationStep]:
    prepared = prepare(made, solver or NewtonSolver())
    return list(simulate_scene(made, prepared, stop, initial_guess="previous", frames=frames, initial_state=state))


def motion(made: Scene, run: list[SimulationStep]) -> np.ndarray:
    """The mean velocity at the end of each step (frames, 3) [m/s]."""
    weight = made.system.mass / made.system.mass.sum()
    return np.array([weight @ step.state.motion.velocity for step in run])


def measure_slip(run: list[SimulationStep]) -> float:
    """How far the first vertex went down the slope [m]."""
    return float(run[-1].positions[0, 0] - run[0].problem.step_start.positions[0, 0])


@cache
def of_name(solver: str) -> Solver:
    return SURFACE_CONTACT_SOLVERS[solver] if solver in SURFACE_CONTACT_SOLVERS else load_target(SOLVERS[solver])()


@pytest.mark.parametrize("solver", TAKE)
def test_a_vertex_sticks_and_slides_from_the_first_step_on(solver):
    """By implicit Euler n steps lead n (n + 1)/2 dt^2 g (sin - mu cos) down the slope."""
    assert 0.0 < measure_slip(steps(pebble(STICKS), 12, of_name(solver))) < 12 / 60 * 1e-5
    found = measure_slip(steps(pebble(SLIPS), 12, of_name(solver)))
    # In the first step the normal force is less by what still moves into the slope, 1e-3 of it.
    assert found == pytest.approx(78 / 60**2 * G * (SIN - SLIPS * COS), rel=1e-3)


@pytest.mark.parametrize("solver", sorted(SURFACE_CONTACT_SOLVERS))
def test_surfaces_exert_coulombs_force_of_the_steps_own_pressure(solver):
    """What slips has m v_x = m g sin t - mu m (g cos t + v_y) at the end of each step, however its pressure changes."""
    made = patch(SLIPS)
    v, t = motion(made, steps(made, 6, of_name(solver), StopRule(2000, 1e-8))), np.arange(1, 7) / 60
    np.testing.assert_allclose(v[:, 0], G * SIN * t - SLIPS * (G * COS * t + v[:, 1]), rtol=2e-3)


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_surfaces_stick_below_the_angle_of_friction_and_slip_above(surface, integrator):
    run = steps(patch(STICKS, SURFACES[surface], integrator=integrator), 12, state=build_pressed_state())
    assert 0.0 < measure_slip(run) < 12 / 60 * 1e-3
    made = patch(SLIPS, SURFACES[surface], integrator=integrator)
    v = motion(made, steps(made, 12, state=build_pressed_state()))[-1, 0]
    assert v == pytest.approx(G * (SIN - SLIPS * COS) * 12 / 60, rel=1e-2 if surface == "mesh" else 0.1)


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_other_integrators_take_the_pressure_of_their_unknown(integrator):
    """Both are exact for a constant force, but for the first step of bdf2, which is of implicit Euler."""
    assert 0.0 < measure_slip(steps(pebble(STICKS, integrator=integrator), 12)) < 1.2 * 12 / 60 * 1e-5
    found, expected = measure_slip(steps(pebble(SLIPS, integrator=integrator), 30)), 0.5 * G * (SIN - SLIPS * COS) / 4
    assert found == pytest.approx(expected, rel=2e-3 if integrator == "bdf2" else 1e-4)


def test_a_slide_converges_with_order_1_by_implicit_euler():
    expected = 0.5 * G * (SIN - SLIPS * COS) / 4
    coarse, fine = (abs(measure_slip(steps(pebble(SLIPS, dt), round(0.5 / dt))) - expected) for dt in (1 / 30, 1 / 60))
    assert coarse / fine == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("dt", [1 / 60, 1 / 960])
def test_what_sticks_creeps_at_a_speed_whatever_the_step(dt):
    """A vertex at y times `eps_v` is pulled back by y times the limit of friction."""
    last = steps(pebble(STICKS, dt, eps_v=2e-4), 16)[-1]
    assert last.state.motion.velocity[0, 0] == pytest.approx(SLOPE / STICKS * 2e-4, rel=1e-3)


def test_a_sheet_on_a_sheet_has_the_steps_own_pressure_too():
    """Momentum law of the upper sheet, from its first step in range on."""
    rough = SelfContactEffect(min_distance=0.01, friction=SLIPS)
    two = StackMesh(width=0.2, height=0.2, layer_spacing=0.0186)
    made = build_test_scene(two, SpringsEffect(stretch=100.0, shear=20.0), rough, size=2, time_step=1 / 60)
    upper = made.mesh.parts["highest"]
    velocity = np.zeros_like(made.mesh.rest_positions)
    velocity[upper] = (1.0, -0.5, 0.0)
    begun = MotionState(build_initial_state(made).motion._replace(velocity=velocity), None, 0)
    run = list(
        simulate_scene(
            made, prepare(made, NewtonSolver()), EXACTLY, initial_guess="previous", frames=3, initial_state=begun
        )
    )
    for step in run:
        v = step.state.motion.velocity[upper].mean(axis=0)
        assert 1.0 - v[0] == pytest.approx(SLIPS * (v[1] + 0.5), rel=0.02)  # some normals lean a little


def test_a_floor_that_slides_and_rises_takes_a_sheet_along_from_the_first_step_on():
    """At 0.5 m/s and 0.1 m/s: friction accelerates the sheet by mu times the normal force where the floor then is."""
    belt = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=10.0, offset=(5.0, 1.0, 0.0))))
    floor = SurfaceContactEffect(
        min_distance=0.01, friction=0.2, obstacles=(SURFACES["mesh"].model_copy(update={"motion": belt}),)
    )
    springs, down = SpringsEffect(stretch=100.0, shear=20.0), GravityEffect()
    made = build_test_scene(GridMesh(width=0.2, height=0.2), springs, down, floor, size=2, time_step=1 / 60)
    v, t = motion(made, steps(made, 4)), np.arange(1, 5) / 60
    np.testing.assert_allclose(v[:, 0], 0.2 * (9.81 * t + v[:, 1]), rtol=1e-3)


class CountingSolver:
    """A prepared solver that counts its solves."""

    def __init__(self, prepared: PreparedSolver) -> None:
        self.prepared, self.problems = prepared, list[StepProblem]()

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        self.problems.append(problem)
        return self.prepared.solve(problem, stop)


def solves(made: Scene, frames: int) -> tuple[list[StepProblem], list[SimulationStep]]:
    counted: Any = CountingSolver(prepare(made, NewtonSolver()))
    return counted.problems, list(simulate_scene(made, counted, EXACTLY, initial_guess="previous", frames=frames))


def test_rounds_are_done_where_friction_acts_and_nowhere_else():
    for made, rounds in ((pebble(0.0), 0), (pebble(SLIPS, friction_iterations=1), 1)):
        problems, run = solves(made, 3)
        assert len(problems) == 3
        assert all(problem.step_start.normal_force_positions is None for problem in problems)
        assert [step.friction_rounds.num_iterations if step.friction_rounds else 0 for step in run] == 3 * [rounds]
    # With the pressure of the step's start the first step is without friction, and the row says what was left.
    assert float(run[0].positions[0, 0]) == pytest.approx(G * SIN / 60**2, rel=1e-9)
    assert run[0].friction_rounds is not None
    assert run[0].friction_rounds.relative_change == 1.0
    problems, run = solves(pebble(SLIPS), 8)
    assert [step.friction_rounds.num_iterations for step in run if step.friction_rounds][:2] == [2, 2]
    assert run[-1].friction_rounds is not None
    assert run[-1].friction_rounds.num_iterations == 1
    assert all(step.friction_rounds.relative_change < 1e-4 for step in run if step.friction_rounds)
    last: Positions | None = run[1].problem.step_start.normal_force_positions
    assert last is not None
    assert np.abs(last - run[1].positions).max() < 1e-3


def test_rows_state_the_friction_rounds_and_their_remaining_change():
    made = pebble(SLIPS)
    (step,) = steps(made, 1)
    row = build_solution_columns(
        made, step, step.problem.evaluate_terms(step.solution.positions), step.solution.residual
    )
    assert row["friction_iterations"] == len(step.iteration_counts) == 2
    assert row["friction_relative_change"] < 1e-4
    made = pebble(0.0)
    (step,) = steps(made, 1)
    row = build_solution_columns(
        made, step, step.problem.evaluate_terms(step.solution.positions), step.solution.residual
    )
    assert row["friction_iterations"] is None
    assert row["friction_relative_change"] is None


class ScriptedSolver:
    """A prepared solver that returns given positions of a pebble, round by round, again and again."""

    def __init__(self, *positions: tuple[float, float]) -> None:
        self.positions, self.solves = positions, 0

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        x, y = self.positions[self.solves % len(self.positions)]
        self.solves += 1
        return Solution(np.array([[x, y, 0.0]]), 1, 0.0, 1.0, "converged")


SLIDING, STICKING, LESS_PRESSED = (2e-3, -2e-3), (1e-7, 1e-4), (1e-3, -1e-3)
"""Of a pebble in a round: pressed, out of range of contact, pressed less."""


@pytest.mark.parametrize(
    ("cycle", "rounds", "end", "change"),
    [((SLIDING, STICKING), 4, STICKING, 1.0), ((SLIDING, LESS_PRESSED, STICKING), 5, LESS_PRESSED, 0.5)],
)
def test_rounds_that_repeat_end_where_most_friction_acts_and_report_what_is_left(cycle, rounds, end, change):
    made = pebble(1e3)
    recited: Any = ScriptedSolver(*cycle)
    solved = solve_with_friction(recited, build_problem(made, build_initial_state(made), "previous"), EXACTLY)
    assert recited.solves == len(solved.iteration_counts) == rounds
    assert tuple(solved.solution.positions[0, :2]) == end
    assert solved.convergence is not None
    assert solved.convergence.num_iterations == rounds
    assert solved.convergence.relative_change == pytest.approx(change)


@pytest.mark.parametrize("factor", [-0.5, 0.5, -0.9])
def test_rounds_that_converge_however_slowly_are_not_cut_short(factor):
    made = pebble(SLIPS, friction_iterations=20)
    recited: Any = ScriptedSolver(*((2e-3, -2e-3 * (1.0 + 0.5 * factor**k)) for k in range(20)))
    solved = solve_with_friction(recited, build_problem(made, build_initial_state(made), "previous"), EXACTLY)
    assert solved.convergence is not None
    assert solved.convergence.num_iterations == 20 or solved.convergence.relative_change <= 1e-4
    assert solved.convergence.num_iterations > 8


def test_a_sheet_on_a_slope_with_very_large_friction_takes_few_rounds():
    """A corner that touches first alternates between sticking out of range and sliding in range."""
    slope = PlaneObstacle(point=(0.0, -0.32, 0.0), normal=(0.5, 1.0, 0.0))
    rough = SurfaceContactEffect(min_distance=0.01, friction=1e3, obstacles=(slope,))
    made = build_test_scene(
        GridMesh(), SpringsEffect(stretch=300.0, shear=60.0), GravityEffect(), rough, size=6, time_step=1 / 30
    )
    last = steps(made, 3, stop=StopRule(400, 1e-6))[-1]
    assert last.friction_rounds is not None
    assert 2 < last.friction_rounds.num_iterations <= 8
    assert last.friction_rounds.relative_change > 0.5


def test_the_force_is_the_slope_of_the_potential_across_the_smoothing_length():
    smoothing_length, limit, lengths = 0.3, 2.0, np.linspace(0.0, 1.0, 2001)
    smoothed, stiffness = np.empty((2, len(lengths)))
    evaluate_friction(np.full(len(lengths), limit), lengths, smoothing_length, smoothed, stiffness)
    forces, slopes = stiffness * lengths, limit * np.diff(smoothed) / np.diff(lengths)
    np.testing.assert_allclose(slopes, 0.5 * (forces[1:] + forces[:-1]), rtol=0, atol=1e-2 * limit)
