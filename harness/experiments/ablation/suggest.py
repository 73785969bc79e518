"""Effects that a scene does not list and its motion calls for, each with the evidence.

An effect's class says itself by what evidence a motion calls for it (`harness.scenes.effects.base.Effect`); here
stands what calls for self-contact.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from harness.experiments.ablation.difference import rest_length
from harness.scenes.bind import Scene
from harness.scenes.effects.base import Seen
from harness.scenes.effects.effect_names import EFFECTS
from solvers.registry import load

NEAR = 0.5
"""Of the mean rest length: vertices that come closer than that lie as good as inside each other."""
LOOKS = 30
"""How many frames are looked at for vertices that come close, evenly spread."""


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
    told = [(kind, _class(kind).called_for(found)) for kind in absent]
    if "self-contact" not in kinds:
        told.append(("self-contact", _too_close(found)))
    return [Suggestion(effect, evidence) for effect, evidence in told if evidence]


def _class(kind: str) -> Any:
    return load(EFFECTS[kind])


def _too_close(seen: Seen) -> str:
    frames, n = len(seen.positions), len(seen.mesh.rest)
    reach = NEAR * seen.length
    known = _codes(np.concatenate([seen.mesh.springs, _pairs(seen.mesh.rest, reach)]), n)
    most, closest, at = 0, np.inf, 0
    for frame in np.unique(np.linspace(0, frames - 1, LOOKS).astype(int)):
        p = seen.positions[frame]
        pairs = _pairs(p, reach)
        pairs = pairs[~np.isin(_codes(pairs, n), known)]
        if len(pairs) > most:
            most, at = len(pairs), int(frame)
        if len(pairs):
            closest = min(closest, float(np.linalg.norm(p[pairs[:, 0]] - p[pairs[:, 1]], axis=1).min()))
    if not most:
        return ""
    return (
        f"{most} pairs of vertices without a spring between them are closer than {NEAR:g} mean rest lengths at "
        f"{seen.time(at):.2f} s, two come as close as {closest / seen.length:.2g}; contact with obstacles "
        "does not keep them apart"
    )


def _pairs(p: NDArray[np.float64], reach: float) -> NDArray[np.int64]:
    """Pairs of vertices (k, 2) that are closer than `reach` [m]."""
    return KDTree(p).query_pairs(reach, output_type="ndarray").astype(np.int64)


def _codes(pairs: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """One number for each pair, whichever end comes first."""
    return pairs.min(axis=1) * n + pairs.max(axis=1)
