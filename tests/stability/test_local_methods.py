"""The hard cases of local-global, for the methods that go vertex by vertex or spring by spring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, simulate_scene
from springbench.solvers.methods.position_based.xpbd import Xpbd, XpbdSmallSteps
from springbench.solvers.methods.time_stepping.symplectic_euler import SymplecticEuler
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.step_problem import Solver, StopRule, Unsupported

from tests.scene_builders import SCENE_BUILDERS, build_cloth, single_stage_integrator
from tests.stability.test_hard_cases import CASES, STEPS, STOP, VALUE, Case, MotionState, resting

METHODS: dict[str, Solver] = {
    "xpbd": Xpbd(),
    "xpbd-small-steps": XpbdSmallSteps(),
    "vbd": VertexBlockDescent(),
    "vbd, not accelerated": VertexBlockDescent(0.0),
    "symplectic-euler": SymplecticEuler(),
}
LEEWAY = 1.6
"""Of the reach: what does not minimise is not damped as implicit Euler is, and ten iterations leave springs longer."""

FREE_FLIGHT = 0.5 * 9.81 * (100.0 * STEPS) ** 2
"""How far a fall of twenty steps of a hundred seconds goes [m]."""

FAR = {
    # Both begin where the vertices would fall to, a hundred kilometres below: ten passes bring them part of the way.
    ("a time step of a hundred seconds", Xpbd): FREE_FLIGHT,
    ("a time step of a hundred seconds", XpbdSmallSteps): FREE_FLIGHT,
}
NEEDS_MASS = {("two thirds of the vertices without mass", kind) for kind in (Xpbd, XpbdSmallSteps, SymplecticEuler)}

methods = pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))


@methods
@pytest.mark.parametrize("name", CASES)
def test_a_hard_case_stays_finite_and_near_and_minimisers_descend(name: str, method: Solver):
    case: Case = CASES[name]
    made = case.scene()
    if (name, type(method)) in NEEDS_MASS:
        with pytest.raises(Unsupported, match="mass"):
            method.prepare(made.system)
        return
    prepared = method.prepare(made.system)
    state = resting(case.start(made.mesh.rest_positions))
    for index in range(1, STEPS + 1):
        stated = build_problem(made, state, "previous")
        solution = prepared.solve(stated, STOP)
        p = solution.positions
        assert np.isfinite(p).all()
        assert np.abs(p).max() <= FAR.get((name, type(method)), LEEWAY * case.reach)
        if method.is_minimiser:
            slack = VALUE * stated.value_scale(stated.initial_guess)
            assert stated.value(p) <= stated.value(stated.initial_guess) + slack
        state = MotionState(
            single_stage_integrator(made).complete_step(stated.step_start, solution), state.motion, index
        )


@methods
@pytest.mark.parametrize("name", ["chain", "net", "cloth", "skirt"])
def test_a_long_run_stays_where_its_springs_can_reach(method, name):
    """Three hundred steps; a vertex is never further below than the scene's height and the springs at twice their
    length under its weight."""
    made = SCENE_BUILDERS[name](1e10)
    steps = simulate_scene(made, method.prepare(made.system), StopRule(10), initial_guess="previous", frames=300)
    reach = 2.0 * np.abs(made.mesh.rest_positions).max() + 2.0 * made.mesh.bounding_box_diagonal
    assert all(np.isfinite(step.positions).all() and np.abs(step.positions).max() <= reach for step in steps)


@pytest.mark.parametrize("time_step", [1e-4, 1e-2, 1.0], ids="{:g} s".format)
@methods
def test_the_scale_of_time_and_length_is_free(method, time_step):
    """In units of another length and time the same motion has the same digits (powers of two change no bit)."""
    length, time = 2.0**20, 2.0**-12
    made = build_cloth(6)
    made = replace(made, system=replace(made.system, time_step=time_step))
    stated = build_problem(made, build_initial_state(made), "previous")
    system = replace(
        made.system,
        mass=made.system.mass * time**2,
        time_step=time_step * time,
        energies=(replace(made.all_springs, rest_length=made.all_springs.rest_length * length),),
    )
    begun = replace(
        stated.step_start,
        positions=stated.step_start.positions * length,
        velocity=stated.step_start.velocity * (length / time),
        velocity_origin=stated.step_start.velocity_origin * length,
        velocity_rate=stated.step_start.velocity_rate / time,
    )
    names = ("inertial_target", "external_force", "pin_targets", "current_positions", "initial_guess")
    scaled = replace(
        stated, system=system, step_start=begun, **{name: getattr(stated, name) * length for name in names}
    )
    found, other = (method.prepare(one.system).solve(one, StopRule(5)).positions for one in (stated, scaled))
    np.testing.assert_array_equal(other, found * length)
