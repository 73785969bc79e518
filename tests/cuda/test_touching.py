"""Contact of vertices with obstacles on a device: vertex block descent's iterates are the processor's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.simulation.measure import Settings, steps
from harness.simulation.on_device import on_device
from harness.simulation.step import State, prepare, problem, start
from solvers.contact.energy import Contact
from solvers.methods.vbd import VertexBlockDescent
from solvers.problem import StepProblem, StopRule
from tests import contacts
from tests.cuda.near import iterates, same_iterates

ITERATIONS = 2
INSIDE = 0.003
"""So deep in the thickness is the deepest vertex where the step starts, and so has friction [m]."""


def touching(name: str) -> StepProblem:
    """A step of a sheet that slides over an obstacle: some vertices press, with friction."""
    made = contacts.sheet(contacts.contact(contacts.OBSTACLES[name], friction=0.5), size=4)
    (energy,) = (energy for energy in made.system.energies if isinstance(energy, Contact))
    state = start(made)
    p, v = state.now.positions.copy(), state.now.velocity - [0.3, 1.0, 0.1]
    for _ in range(40):  # down to it, by no more than the distance at a time
        p[:, 1] -= energy.obstacles[0].distance(p, 0.0).min() - energy.thickness + INSIDE
    found = problem(made, State(state.now._replace(positions=p, velocity=v), None, 0), "current")
    (energy,) = (energy for energy in found.energies if isinstance(energy, Contact))
    end = iterates(VertexBlockDescent(), found, ITERATIONS)[-1]
    assert (energy.gap(end) < 0.0).any()
    assert energy.planes.grip.any()
    return found


@pytest.mark.parametrize("rounds", [1, 2])
@pytest.mark.parametrize("name", ["plane", "capsule", "tilted box"])
def test_iterates_against_an_obstacle_are_those_of_the_processor(name: str, rounds: int) -> None:
    found = touching(name)
    if rounds > 1:
        x = iterates(VertexBlockDescent(), found, ITERATIONS)[-1].copy()
        found = replace(found, first_guess=x, start=replace(found.start, pressed=x))
    same_iterates(VertexBlockDescent, found, ITERATIONS)


def test_a_host_iterates_the_normal_forces_of_friction_and_timed_steps_repeat_its_rounds() -> None:
    """The sheet lands: friction takes more than one solve, and each is replayed with its own iterations."""
    made = contacts.sheet(
        contacts.contact(contacts.OBSTACLES["plane"], friction=0.5), size=3, velocity=(0.5, -8.0, 0.0)
    )
    settings = Settings(StopRule(2), "current", 2, 1)
    found = on_device(prepare(made, VertexBlockDescent(device="cuda", precision="float64")))
    assert found is not None
    first = list(steps(made, found, settings))
    for step in first:
        found.keep(step)
    assert max(len(step.counts) for step in first) > 1
    again = list(steps(made, found.again(), settings))
    for one, other in zip(first, again, strict=True):
        assert one.counts == other.counts
        np.testing.assert_array_equal(one.positions, other.positions)
