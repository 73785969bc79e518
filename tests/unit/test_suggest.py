"""What a motion calls for: suggestions with their evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from springbench.harness.experiments.ablation.ablation_unit import EffectSuggestion, build_evidence, suggest_effects
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.scene_builder import Scene

from tests.effect_scenes import build_effect_cloth
from tests.scene_builders import build_test_scene


def suggest(
    made: Scene, kinds: set[str], positions: np.ndarray, velocities: np.ndarray | float = 0.0
) -> list[EffectSuggestion]:
    """What a motion calls for that passes through positions (n, 3) for 12 frames."""
    places = np.tile(positions, (12, 1, 1))
    return suggest_effects(build_evidence(made, kinds, places, np.broadcast_to(velocities, places.shape)), kinds)


def fold_cloth(made: Scene, angle: float) -> np.ndarray:
    """The level cloth, folded along its middle."""
    x, y, z = made.mesh.rest_positions.T
    right = np.maximum(x, 0.0)
    return np.stack([x - right + right * np.cos(angle), y + right * np.sin(angle), z], axis=1)


def still() -> Scene:
    made = replace(build_effect_cloth(), varying_forces=(), pin_motions=())
    assert suggest(made, set(), made.mesh.rest_positions) == []
    return made


def test_a_motion_without_special_needs_gets_no_suggestion():
    made = still()
    assert suggest(made, set(), fold_cloth(made, np.deg2rad(20.0))) == []


@pytest.mark.parametrize(
    ("effect", "listed", "evidence"),
    [
        ("strain-limits", "strain-limits", "one by 12 %"),
        ("bending", "bending", "of the edges"),
        ("air-drag", "rayleigh", "100 %"),
    ],
)
def test_a_suggestion_comes_with_its_evidence_unless_the_effect_is_listed(effect: str, listed: str, evidence: str):
    made = still()
    places = {
        "strain-limits": 1.12 * made.mesh.rest_positions,
        "bending": fold_cloth(made, 0.8 * np.pi),
        "air-drag": made.mesh.rest_positions,
    }
    speed = 1.0 if effect == "air-drag" else 0.0
    found = {s.effect_kind: s.evidence for s in suggest(made, set(), places[effect], speed)}
    assert evidence in found[effect]
    assert effect not in {s.effect_kind for s in suggest(made, {listed}, places[effect], speed)}


def test_a_corner_alone_suggests_no_effect():
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0, shear=60.0), size=20)
    p, h = made.mesh.rest_positions.copy(), made.mesh.spacing
    p[0] += [-h, 2 * h, -h]  # three springs of 1482, and two edges of 1083
    assert suggest(made, set(), p) == []
    p[made.mesh.parts["left"]] += [0.0, 3 * h, 0.0]
    assert {s.effect_kind for s in suggest(made, set(), p)} == {"strain-limits", "bending"}


def test_vertices_that_come_close_are_counted():
    made = still()
    found = {s.effect_kind: s.evidence for s in suggest(made, set(), fold_cloth(made, np.pi * 0.99))}
    # Of 6 columns the inner two are joined by springs; each outer pair lies on each other in all 6 rows.
    assert found["self-contact"].startswith("12 pairs of vertices without a spring")


def test_a_body_that_flies_as_a_whole_need_not_come_to_rest():
    free = build_test_scene(GridMesh(), SpringsEffect(stretch=300.0), size=4)
    assert suggest(free, set(), free.mesh.rest_positions, 1.0) == []
    swelling = suggest(free, set(), free.mesh.rest_positions, free.mesh.rest_positions)
    assert [s.effect_kind for s in swelling] == ["air-drag"]


def test_a_driven_motion_need_not_come_to_rest():
    made = replace(still(), varying_forces=(lambda p, v, t: p,))
    assert suggest(made, set(), made.mesh.rest_positions, 1.0) == []
