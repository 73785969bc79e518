"""Suggest effects that a scene does not list although its motion indicates them.

Each suggestion states its evidence. The class of an effect defines the evidence for it
(`springbench.harness.scenes.effects.effect_interface.SceneEffect`).
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.experiments.ablation.motion_difference import compute_mean_rest_length
from springbench.harness.scenes.effects.effect_interface import ObservedMotion
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES, EFFECT_TABLE
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.registry import load_target


class EffectSuggestion(NamedTuple):
    """Kind of the suggested effect, and the evidence for it."""

    effect_kind: str
    evidence: str


def build_evidence(
    scene: Scene, effect_kinds: Collection[str], positions: NDArray[np.float64], velocities: NDArray[np.float64]
) -> ObservedMotion:
    """Collect the evidence from a scene and its motion.

    Args:
        scene: the scene.
        effect_kinds: kinds of its effects.
        positions: (frames, n, 3) [m].
        velocities: (frames, n, 3) [m/s].
    """
    return ObservedMotion(
        mesh=scene.mesh,
        springs=scene.all_springs,
        mean_spring_length=compute_mean_rest_length(scene),
        mass=scene.system.mass,
        time_step=scene.system.time_step,
        has_pins=bool(len(scene.system.pins.vertices)),
        is_driven=bool(scene.varying_forces or scene.pin_motions),
        is_damped=any(getattr(_load_effect_class(kind), "is_dissipative", False) for kind in effect_kinds),
        positions=positions,
        velocities=velocities,
    )


def suggest_effects(evidence: ObservedMotion, effect_kinds: Collection[str]) -> list[EffectSuggestion]:
    """Return the unlisted effects that the evidence indicates, in a fixed order.

    Args:
        evidence: evidence from the motion.
        effect_kinds: kinds of the effects that the scene lists.
    """
    absent = [
        kind
        for kind in EFFECT_CLASSES
        if kind not in effect_kinds and hasattr(_load_effect_class(kind), "find_evidence")
    ]
    suggestions = (EffectSuggestion(kind, _load_effect_class(kind).find_evidence(evidence)) for kind in absent)
    return [suggestion for suggestion in suggestions if suggestion.evidence]


def _load_effect_class(kind: str) -> Any:
    return load_target(EFFECT_TABLE[kind])
