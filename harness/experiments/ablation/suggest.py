"""Effects that a scene does not list and its motion calls for, each with the evidence.

An effect's class says itself by what evidence a motion calls for it (`harness.scenes.effects.base.Effect`).
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
    """An effect by name, and why."""

    effect: str
    evidence: str


def seen(scene: Scene, kinds: Collection[str], positions: NDArray[np.float64], velocities: NDArray[np.float64]) -> Seen:
    """A scene with effects of these kinds and its motion, positions [m] and velocities [m/s] (frames, n, 3)."""
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
    """What the motion calls for, less the `kinds` that the scene lists; in a fixed order."""
    absent = [kind for kind in EFFECTS if kind not in kinds and hasattr(_class(kind), "called_for")]
    told = (Suggestion(kind, _class(kind).called_for(found)) for kind in absent)
    return [suggestion for suggestion in told if suggestion.evidence]


def _class(kind: str) -> Any:
    return load(EFFECTS[kind])
