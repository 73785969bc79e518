"""Contact of vertices with obstacles on a device: vertex block descent's iterates are the processor's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from springbench.harness.simulation.device_stepping import wrap_device_solver
from springbench.harness.simulation.time_loop import MotionState, build_initial_state, build_problem, prepare
from springbench.harness.simulation.timing_pass import SteppingSettings, iterate_steps
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.step_problem import StepProblem, StopRule

from tests import contact_scenes
from tests.cuda.near import iterates, same_iterates

ITERATIONS = 2
INSIDE = 0.003
"""So deep in the thickness is the deepest vertex where the step starts, and so has friction [m]."""


def touching(name: str) -> StepProblem:
    """A step of a sheet that slides over an obstacle: some vertices press, with friction."""
    made = contact_scenes.build_sheet(
        contact_scenes.build_contact(contact_scenes.OBSTACLE_SPECS[name], friction=0.5), size=4
    )
    (energy,) = (energy for energy in made.system.energies if isinstance(energy, HalfSpaceContact))
    state = build_initial_state(made)
    p, v = state.motion.positions.copy(), state.motion.velocity - [0.3, 1.0, 0.1]
    for _ in range(40):  # down to it, by no more than the distance at a time
        p[:, 1] -= energy.obstacles[0].signed_distance(p, 0.0).min() - energy.min_distance + INSIDE
    found = build_problem(made, MotionState(state.motion._replace(positions=p, velocity=v), None, 0), "previous")
    (energy,) = (energy for energy in found.energies if isinstance(energy, HalfSpaceContact))
    end = iterates(VertexBlockDescent(), found, ITERATIONS)[-1]
    assert (energy.compute_gaps(end) < 0.0).any()
    assert energy.active_planes.friction_limit.any()
    return found


@pytest.mark.parametrize("rounds", [1, 2])
@pytest.mark.parametrize("name", ["plane", "capsule", "tilted box"])
def test_iterates_against_an_obstacle_are_those_of_the_processor(name: str, rounds: int) -> None:
    found = touching(name)
    if rounds > 1:
        x = iterates(VertexBlockDescent(), found, ITERATIONS)[-1].copy()
        found = replace(found, initial_guess=x, step_start=replace(found.step_start, normal_force_positions=x))
    same_iterates(VertexBlockDescent, found, ITERATIONS)


def test_a_host_iterates_the_normal_forces_of_friction_and_timed_steps_repeat_its_rounds() -> None:
    """The sheet lands: friction takes more than one solve, and each is replayed with its own iterations."""
    made = contact_scenes.build_sheet(
        contact_scenes.build_contact(contact_scenes.OBSTACLE_SPECS["plane"], friction=0.5),
        size=3,
        velocity=(0.5, -8.0, 0.0),
    )
    settings = SteppingSettings(StopRule(2), "previous", 2, 1)
    found = wrap_device_solver(prepare(made, VertexBlockDescent(device="cuda", precision="float64")))
    assert found is not None
    first = list(iterate_steps(made, found, settings))
    for step in first:
        found.record_counts(step)
    assert max(len(step.iteration_counts) for step in first) > 1
    again = list(iterate_steps(made, found.build_replay(), settings))
    for one, other in zip(first, again, strict=True):
        assert one.iteration_counts == other.iteration_counts
        np.testing.assert_array_equal(one.positions, other.positions)
