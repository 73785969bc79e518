"""The hard cases of local-global, for the methods that go vertex by vertex or spring by spring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.simulation.step import problem, simulate, start
from solvers.methods.symplectic_euler import SymplecticEuler
from solvers.methods.vbd import VertexBlockDescent
from solvers.methods.xpbd import Xpbd, XpbdSmallSteps
from solvers.problem import Solver, StopRule, Unsupported
from tests.scenes import SCENES, cloth, of_one_unknown
from tests.stability.test_hard_cases import CASES, STEPS, STOP, VALUE, Case, State, resting

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
    state = resting(case.start(made.mesh.rest))
    for index in range(1, STEPS + 1):
        stated = problem(made, state, "current")
        solution = prepared.solve(stated, STOP)
        p = solution.positions
        assert np.isfinite(p).all()
        assert np.abs(p).max() <= FAR.get((name, type(method)), LEEWAY * case.reach)
        if method.minimises:
            slack = VALUE * stated.magnitude(stated.first_guess)
            assert stated.value(p) <= stated.value(stated.first_guess) + slack
        state = State(of_one_unknown(made).advance(stated.start, solution), state.now, index)


@methods
@pytest.mark.parametrize("name", ["chain", "net", "cloth", "skirt"])
def test_a_long_run_stays_where_its_springs_can_reach(method, name):
    """Three hundred steps; a vertex is never further below than the scene's height and the springs at twice their
    length under its weight."""
    made = SCENES[name](1e10)
    steps = simulate(made, method.prepare(made.system), StopRule(10), first_guess="current", frames=300)
    reach = 2.0 * np.abs(made.mesh.rest).max() + 2.0 * made.mesh.size
    assert all(np.isfinite(step.positions).all() and np.abs(step.positions).max() <= reach for step in steps)


@pytest.mark.parametrize("time_step", [1e-4, 1e-2, 1.0], ids="{:g} s".format)
@methods
def test_the_scale_of_time_and_length_is_free(method, time_step):
    """In units of another length and time the same motion has the same digits (powers of two change no bit)."""
    length, time = 2.0**20, 2.0**-12
    made = cloth(6)
    made = replace(made, system=replace(made.system, time_step=time_step))
    stated = problem(made, start(made), "current")
    system = replace(
        made.system,
        mass=made.system.mass * time**2,
        time_step=time_step * time,
        energies=(replace(made.springs, rest_length=made.springs.rest_length * length),),
    )
    begun = replace(
        stated.start,
        positions=stated.start.positions * length,
        velocity=stated.start.velocity * (length / time),
        origin=stated.start.origin * length,
        rate=stated.start.rate / time,
    )
    names = ("target", "force", "pin_targets", "current", "first_guess")
    scaled = replace(stated, system=system, start=begun, **{name: getattr(stated, name) * length for name in names})
    found, other = (method.prepare(one.system).solve(one, StopRule(5)).positions for one in (stated, scaled))
    np.testing.assert_array_equal(other, found * length)
