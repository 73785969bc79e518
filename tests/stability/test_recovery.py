"""From a collapsed, a flattened, a random start every minimiser comes back within a hundred steps.

To the rest shape where there is a way without a barrier, else to where a certified minimum of the static energy is: a
tangle may hold itself. Implicit Euler damps what the start sets in motion.

Each minimiser meets each start and each mesh, and every case neighbours in the registry's order, which are of a kind;
`-m long` runs the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from harness.reference.minimiser import certify
from harness.scenes.bind import Scene
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.solids import Block
from harness.scenes.start import AnyStart, Collapsed, Flattened, Random
from harness.simulation.step import State, prepare, problem, simulate
from solvers.integrators import Motion
from solvers.problem import Positions, StopRule
from solvers.registry import SOLVERS, load
from tests.often import often
from tests.scenes import scene

STEPS, STOP = 100, StopRule(200, 1e-6)
"""Steps of at most so many iterations, converged or not: a step cut short damps more."""

MINIMISERS = [name for name, target in SOLVERS.items() if load(target).minimises]


def held_block() -> Scene:
    """Its left side does not move; nothing pulls."""
    return scene(
        Block(), Springs(stretch=2e4), Pins.model_validate({"at": ["left"], "weight": "exact"}), size=4, mass=10.0
    )


def free_block() -> Scene:
    return scene(Block(), Springs(stretch=2e4), size=4, mass=10.0)


def hanging_cloth() -> Scene:
    """In steps of .2 s, which damp."""
    pins = Pins.model_validate({"at": ["top_corners"], "weight": "exact"})
    return scene(Grid(), Springs(stretch=30.0, shear=6.0), Gravity(), pins, size=5, mass=0.3, time_step=0.2)


def returns_to_its_rest_shape(made: Scene, p: Positions) -> None:
    # Of positions of a metre or less, what the tolerance and a hundred steps of drift leave.
    np.testing.assert_allclose(p, made.mesh.rest, rtol=0, atol=1e-10)


def returns_to_its_lengths(made: Scene, p: Positions) -> None:
    """The rest shape, wherever it has drifted and however it is turned."""
    np.testing.assert_allclose(made.springs.lengths(p), made.springs.rest_length, rtol=0, atol=1e-10)  # as above


def comes_to_a_minimum(made: Scene, p: Positions) -> None:
    system = replace(made.system, time_step=1e6)  # inertia weighs nothing
    static = problem(replace(made, system=system), State(Motion(p, np.zeros_like(p)), None, 0), "current")
    minimum = certify(static, p)
    assert minimum.certified, minimum.flaw
    # A hundredth of the size: what is left after a hundred steps of swings that gravity alone brings back.
    np.testing.assert_allclose(p, minimum.positions, rtol=0, atol=1e-2 * made.mesh.size)


LINE, PLANE = Flattened(along=("y", "z")), Flattened(along=("y",))
Check = Callable[[Scene, Positions], None]
CASES: dict[str, tuple[Callable[[], Scene], AnyStart, Check]] = {
    "a held block in one point": (held_block, Collapsed(), returns_to_its_rest_shape),
    "a held block in a line": (held_block, LINE, returns_to_its_rest_shape),
    "a held block in a plane": (held_block, PLANE, returns_to_its_rest_shape),
    "a held block at random": (held_block, Random(side=1.0), comes_to_a_minimum),
    "a free block in one point": (free_block, Collapsed(), returns_to_its_lengths),
    "a free block in a line": (free_block, LINE, returns_to_its_lengths),
    "a free block in a plane": (free_block, PLANE, returns_to_its_lengths),
    "a hanging cloth in one point": (hanging_cloth, Collapsed(), comes_to_a_minimum),
    "a hanging cloth in a line": (hanging_cloth, LINE, comes_to_a_minimum),
    "a hanging cloth at random": (hanging_cloth, Random(side=1.0), comes_to_a_minimum),
}


ROUNDS = (
    ("a held block in one point", "a free block in a line", "a held block in a plane", "a hanging cloth at random"),
    ("a free block in one point", "a hanging cloth in a line", "a held block in a plane", "a held block at random"),
    ("a hanging cloth in one point", "a held block in a line", "a free block in a plane", "a held block at random"),
)
"""What one minimiser is tried with, the next and the one after, in turn."""
OFTEN = [(case, name) for k, name in enumerate(MINIMISERS) for case in ROUNDS[k % len(ROUNDS)]]


@pytest.mark.parametrize(("case", "name"), often(product(CASES, MINIMISERS), OFTEN))
def test_the_scene_recovers(case: str, name: str):
    build, begun, check = CASES[case]
    made = replace(build(), start=begun)
    assert not np.allclose(begun.positions(made.mesh.rest), made.mesh.rest, atol=0.1)
    run = simulate(made, prepare(made, load(SOLVERS[name])()), STOP, first_guess="current", frames=STEPS)
    *_, last = run
    check(made, last.positions)
