"""Suggest effects that a scene does not list although its motion indicates them.

Each comes with the evidence.

The class of an effect defines the evidence for it (`harness.scenes.effects.base.Effect`).
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from harness.experiments.ablation.difference import rest_length
from harness.scenes.bind import Scene
from harness.scenes.effects.base import Seen
from harness.scenes.effects.effect_names import EFFECTS
from solvers.registry import load


class Suggestion(NamedTuple):
    """Kind of the suggested effect, and the evidence for it."""

    effect: str
    evidence: str


def seen(scene: Scene, kinds: Collection[str], positions: NDArray[np.float64], velocities: NDArray[np.float64]) -> Seen:
    """Collect the evidence from a scene and its motion.

    Args:
        scene: the scene.
        kinds: kinds of its effects.
        positions: (frames, n, 3) [m].
        velocities: (frames, n, 3) [m/s].
    """
    return Seen(
        mesh=scene.mesh,
        springs=scene.springs,
        length=rest_length(scene),
        mass=scene.system.mass,
        time_step=scene.system.time_step,
        held=bool(len(scene.system.pins.vertices)),
        driven=bool(scene.forces or scene.moving),
        damped=any(getattr(_class(kind), "damps", False) for kind in kinds),
        positions=positions,
        velocities=velocities,
    )


def suggestions(found: Seen, kinds: Collection[str]) -> list[Suggestion]:
    """Return the unlisted effects that the evidence indicates, in a fixed order.

    Args:
        found: evidence from the motion.
        kinds: kinds of the effects that the scene lists.
    """
    absent = [kind for kind in EFFECTS if kind not in kinds and hasattr(_class(kind), "called_for")]
    told = (Suggestion(kind, _class(kind).called_for(found)) for kind in absent)
    return [suggestion for suggestion in told if suggestion.evidence]


def _class(kind: str) -> Any:
    return load(EFFECTS[kind])
