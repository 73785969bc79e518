"""Hard cases stay numerically stable: numbers stay numbers, energy descends, nothing flies off, backends agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np
import pytest
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState, build_problem
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import DirichletPins, Positions, Solver, StopRule, System

from tests.scene_builders import (
    LOCAL_GLOBAL_BACKENDS,
    SCENE_BUILDERS,
    build_cloth,
    build_first_problem,
    compute_static_shape,
    simulate_trajectory,
    single_stage_integrator,
)

backends = pytest.mark.parametrize("backend", LOCAL_GLOBAL_BACKENDS, ids=lambda b: type(b).__name__)

STEPS, STOP = 20, StopRule(10)
VALUE = 1e-12
"""Round-off of the objective relative to its magnitude, in sums of a thousand terms."""
AGREEMENT = 1e-12
"""Of backends, relative to the reach: the worst, the tower, leaves 2e-14 after ten iterations, most leave 1e-15.
Weights far apart do no harm, since a Cholesky factorisation is accurate whatever the scale of rows and columns."""


class Case(NamedTuple):
    """scene: what is simulated; start: its first positions from those at rest, at no velocity; reach: how far from
    the origin a coordinate may get [m].
    """

    scene: Callable[[], Scene]
    start: Callable[[Positions], Positions]
    reach: float


def at_rest(rest: Positions) -> Positions:
    return rest


def build_changed_cloth(**system) -> Scene:
    made = build_cloth(8)
    return replace(made, system=replace(made.system, **system))


def heavy_and_light() -> Scene:
    mass = build_cloth(8).system.mass
    return build_changed_cloth(mass=mass * np.where(np.arange(len(mass)) % 2, 1e4, 1e-4))


def mostly_massless() -> Scene:
    mass = build_cloth(8).system.mass
    return build_changed_cloth(mass=np.where(np.arange(len(mass)) % 3, 0.0, mass))


def weights(w: float) -> Scene:
    made = build_cloth(8)
    vertices = made.system.pins.vertices
    return replace(made, system=replace(made.system, pins=DirichletPins(vertices, np.full(len(vertices), w))))


def far_away(distance: float) -> Scene:
    made = build_cloth(8)
    rest = made.mesh.rest_positions + distance
    return replace(made, mesh=replace(made.mesh, rest_positions=rest), pin_targets=made.pin_targets + distance)


def tangle_positions(rest: Positions) -> Positions:
    return np.random.default_rng(0).normal(size=rest.shape)


# A cloth of 1 m by 1 m that hangs from two corners reaches 1 m below them, and half as far again as it stretches.
CASES = {
    "a time step of a hundred seconds": Case(lambda: build_changed_cloth(time_step=100.0), at_rest, 1.5),
    "a time step of a microsecond": Case(lambda: build_changed_cloth(time_step=1e-6), at_rest, 0.51),
    "springs of 1e9 N/m": Case(lambda: build_cloth(8, stretch=1e9), at_rest, 1.1),
    "springs of 1e-6 N/m fall freely": Case(lambda: build_cloth(8, stretch=1e-6), at_rest, 2.3),
    "masses eight orders apart": Case(heavy_and_light, at_rest, 1.5),
    "two thirds of the vertices without mass": Case(mostly_massless, at_rest, 1.5),
    "pins of 1e16 N/m": Case(lambda: weights(1e16), at_rest, 1.5),
    "pins of 1e-3 N/m fall freely": Case(lambda: weights(1e-3), at_rest, 2.4),
    "far from the origin": Case(lambda: far_away(1e6), at_rest, 1e6 + 1.5),
    "collapsed into a point": Case(lambda: build_cloth(8), np.zeros_like, 1.5),
    "flattened to a line": Case(lambda: build_cloth(8), lambda rest: rest * [1.0, 0.0, 0.0], 1.5),
    "turned inside out": Case(lambda: build_cloth(8), np.negative, 2.0),
    "tangled": Case(lambda: build_cloth(8), tangle_positions, 4.0),
    "tangled, exact pins": Case(lambda: build_cloth(8, "exact"), tangle_positions, 4.0),
    "a tangle of a stiff block": Case(lambda: SCENE_BUILDERS["block"](1e10), tangle_positions, 4.0),
    "stretched a thousandfold": Case(lambda: build_cloth(8), lambda rest: 1e3 * rest, 500.0),
    "a stiff tower of 3 m": Case(lambda: SCENE_BUILDERS["tower"](1e10), at_rest, 3.1),
}
cases = pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))


def resting(positions: Positions) -> MotionState:
    return MotionState(Motion(positions, np.zeros_like(positions)), None, 0)


@backends
@cases
def test_a_hard_case_descends_stays_finite_and_near(case: Case, backend: Solver):
    made = case.scene()
    prepared = backend.prepare(made.system)
    positions = case.start(made.mesh.rest_positions)
    state = resting(positions)
    for index in range(1, STEPS + 1):
        stated = build_problem(made, state, "previous")
        solution = prepared.solve(stated, STOP)
        p = solution.positions
        assert np.isfinite(p).all()
        assert np.abs(p).max() <= case.reach
        slack = VALUE * stated.value_scale(stated.initial_guess)
        assert stated.value(p) <= stated.value(stated.initial_guess) + slack
        state = MotionState(
            single_stage_integrator(made).complete_step(stated.step_start, solution), state.motion, index
        )


@cases
def test_backends_agree_on_a_hard_case(case: Case):
    made = case.scene()
    positions = case.start(made.mesh.rest_positions)
    stated = build_problem(made, resting(positions), "previous")
    found = [list(islice(backend.prepare(made.system).iterates(stated), 10))[-1] for backend in LOCAL_GLOBAL_BACKENDS]
    assert np.ptp(found, axis=0).max() <= AGREEMENT * case.reach


@backends
def test_a_long_run_comes_to_rest_in_the_static_shape(backend):
    made = SCENE_BUILDERS["chain"](1e10)
    p = simulate_trajectory(made, backend, 1500, iterations=30)
    assert np.isfinite(p).all()
    # Implicit Euler damps the slowest swing, of some hertz, to e^-15; ends are then equal to the solves' accuracy.
    np.testing.assert_allclose(p[-1], compute_static_shape(made), rtol=0, atol=1e-6)


@backends
@pytest.mark.parametrize("time_step", [1e-4, 1.0, 1e4], ids="{:g} s".format)
def test_the_scale_of_time_and_length_is_free(backend, time_step):
    """In units of another length and time the same motion has the same digits (powers of two change no bit)."""
    length, time = 2.0**20, 2.0**-12
    made = build_cloth(6)
    made = replace(made, system=replace(made.system, time_step=time_step))
    stated = build_first_problem(made)
    scaled = replace(
        stated,
        system=System(
            made.system.mass * time**2,
            time_step * time,
            tuple(replace(s, rest_length=s.rest_length * length) for s in (made.all_springs,)),
            made.system.pins,
        ),
        external_force=stated.external_force * length,
        **{
            name: getattr(stated, name) * length
            for name in ("inertial_target", "pin_targets", "current_positions", "initial_guess")
        },
    )
    found, other = (list(islice(backend.prepare(one.system).iterates(one), 5))[-1] for one in (stated, scaled))
    np.testing.assert_array_equal(other, found * length)
