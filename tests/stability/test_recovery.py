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
from springbench.harness.reference.certified_minimum import certify_minimum
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.start_positions import AnyStart, CollapsedStart, FlattenedStart, RandomStart
from springbench.harness.simulation.time_loop import MotionState, build_problem, prepare, simulate_scene
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.rare_cases import mark_rare_cases
from tests.scene_builders import build_test_scene

STEPS, STOP = 100, StopRule(200, 1e-6)
"""Steps of at most so many iterations, converged or not: a step cut short damps more."""

MINIMISERS = [name for name, target in SOLVERS.items() if load_target(target).is_minimiser]


def pinned_block() -> Scene:
    """Its left side does not move; nothing pulls."""
    return build_test_scene(
        BlockMesh(),
        SpringsEffect(stretch=2e4),
        PinsEffect.model_validate({"parts": ["left"], "weight": "exact"}),
        size=4,
        mass=10.0,
    )


def free_block() -> Scene:
    return build_test_scene(BlockMesh(), SpringsEffect(stretch=2e4), size=4, mass=10.0)


def hanging_cloth() -> Scene:
    """In steps of .2 s, which damp."""
    pins = PinsEffect.model_validate({"parts": ["top_corners"], "weight": "exact"})
    return build_test_scene(
        GridMesh(), SpringsEffect(stretch=30.0, shear=6.0), GravityEffect(), pins, size=5, mass=0.3, time_step=0.2
    )


def returns_to_its_rest_shape(made: Scene, p: Positions) -> None:
    # Of positions of a metre or less, what the tolerance and a hundred steps of drift leave.
    np.testing.assert_allclose(p, made.mesh.rest_positions, rtol=0, atol=1e-10)


def returns_to_its_lengths(made: Scene, p: Positions) -> None:
    """The rest shape, wherever it has drifted and however it is turned."""
    np.testing.assert_allclose(
        made.all_springs.edge_lengths(p), made.all_springs.rest_length, rtol=0, atol=1e-10
    )  # as above


def comes_to_a_minimum(made: Scene, p: Positions) -> None:
    system = replace(made.system, time_step=1e6)  # inertia weighs nothing
    static = build_problem(replace(made, system=system), MotionState(Motion(p, np.zeros_like(p)), None, 0), "previous")
    minimum = certify_minimum(static, p)
    assert minimum.is_certified, minimum.flaw_description
    # A hundredth of the size: what is left after a hundred steps of swings that gravity alone brings back.
    np.testing.assert_allclose(p, minimum.positions, rtol=0, atol=1e-2 * made.mesh.bounding_box_diagonal)


LINE, PLANE = FlattenedStart(axes=("y", "z")), FlattenedStart(axes=("y",))
Check = Callable[[Scene, Positions], None]
CASES: dict[str, tuple[Callable[[], Scene], AnyStart, Check]] = {
    "a held block in one point": (pinned_block, CollapsedStart(), returns_to_its_rest_shape),
    "a held block in a line": (pinned_block, LINE, returns_to_its_rest_shape),
    "a held block in a plane": (pinned_block, PLANE, returns_to_its_rest_shape),
    "a held block at random": (pinned_block, RandomStart(side_length=1.0), comes_to_a_minimum),
    "a free block in one point": (free_block, CollapsedStart(), returns_to_its_lengths),
    "a free block in a line": (free_block, LINE, returns_to_its_lengths),
    "a free block in a plane": (free_block, PLANE, returns_to_its_lengths),
    "a hanging cloth in one point": (hanging_cloth, CollapsedStart(), comes_to_a_minimum),
    "a hanging cloth in a line": (hanging_cloth, LINE, comes_to_a_minimum),
    "a hanging cloth at random": (hanging_cloth, RandomStart(side_length=1.0), comes_to_a_minimum),
}


ROUNDS = (
    ("a held block in one point", "a free block in a line", "a held block in a plane", "a hanging cloth at random"),
    ("a free block in one point", "a hanging cloth in a line", "a held block in a plane", "a held block at random"),
    ("a hanging cloth in one point", "a held block in a line", "a free block in a plane", "a held block at random"),
)
"""What one minimiser is tried with, the next and the one after, in turn."""
OFTEN = [(case, name) for k, name in enumerate(MINIMISERS) for case in ROUNDS[k % len(ROUNDS)]]


@pytest.mark.parametrize(("case", "name"), mark_rare_cases(product(CASES, MINIMISERS), OFTEN))
def test_the_scene_recovers(case: str, name: str):
    build, begun, check = CASES[case]
    made = replace(build(), start=begun)
    assert not np.allclose(begun.compute_positions(made.mesh.rest_positions), made.mesh.rest_positions, atol=0.1)
    run = simulate_scene(
        made, prepare(made, load_target(SOLVERS[name])()), STOP, initial_guess="previous", frames=STEPS
    )
    *_, last = run
    check(made, last.positions)
