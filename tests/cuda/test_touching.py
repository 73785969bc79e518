"""Contact of vertices with obstacles on a device: vertex block descent's iterates are the processor's."""

from __future__ import annotations

import pytest

from harness.simulation.step import State, problem, start
from solvers.contact.energy import Contact
from solvers.methods.vbd import VertexBlockDescent
from solvers.problem import StepProblem
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


@pytest.mark.parametrize("name", ["plane", "capsule", "tilted box"])
def test_iterates_against_an_obstacle_are_those_of_the_processor(name: str) -> None:
    same_iterates(VertexBlockDescent, touching(name), ITERATIONS)
