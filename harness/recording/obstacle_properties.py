"""Obstacles of a scene, and the property of a recording that declares them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # a scene without obstacles imports none of them
    from springbench.harness.scenes.effects.effect_interface import SceneEffect
    from springbench.harness.scenes.surface_obstacles import AnySurface

OBSTACLES_PROPERTY = "obstacles"
"""Property of a recording that declares its obstacles in JSON, in the format of scene files."""


def list_obstacles(effects: Iterable[SceneEffect]) -> tuple[AnySurface, ...]:
    """Return the obstacles of a scene's effects, to be drawn with the mesh."""
    return tuple(one for effect in effects for one in getattr(effect, "obstacles", ()))


def build_obstacles_property(obstacles: Sequence[AnySurface]) -> dict[str, str]:
    """Return the property that declares these obstacles; empty where there are none."""
    return (
        {OBSTACLES_PROPERTY: f"[{', '.join(one.model_dump_json(exclude_none=True) for one in obstacles)}]"}
        if obstacles
        else {}
    )
