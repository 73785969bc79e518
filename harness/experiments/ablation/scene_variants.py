"""Variants of a scene: the full one, and without each effect or pair."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations

from springbench.harness.scenes.scene_spec import SceneSpec


@dataclass(frozen=True, slots=True, eq=False)
class SceneVariant:
    """Scene without the effects `omitted_effects`, by name; the full scene omits none."""

    omitted_effects: tuple[str, ...]
    scene: SceneSpec

    @property
    def name(self) -> str:
        """The omitted effects, joined by +."""
        return "+".join(self.omitted_effects)


def build_variants(scene: SceneSpec, *, with_pairs: bool) -> list[SceneVariant]:
    """Build the full scene, then one variant without each effect in order.

    Args:
        scene: scene with all of its effects.
        with_pairs: whether to add a variant without each pair of effects, at the end.
    """
    names = name_effects(scene)
    chosen: list[tuple[int, ...]] = [(), *((i,) for i in range(len(names)))]
    if with_pairs:
        chosen += combinations(range(len(names)), 2)
    return [SceneVariant(tuple(names[i] for i in out), _omit_effects(scene, out)) for out in chosen]


def name_effects(scene: SceneSpec) -> list[str]:
    """Return the name of each effect.

    It is the kind, with the index in the list where a scene lists two of a kind.
    """
    count = Counter(effect.kind for effect in scene.effects)
    return [e.kind if count[e.kind] == 1 else f"{e.kind}[{i}]" for i, e in enumerate(scene.effects)]


def _omit_effects(scene: SceneSpec, omitted: tuple[int, ...]) -> SceneSpec:
    values = {key: getattr(scene, key) for key in SceneSpec.model_fields}
    remaining = [i for i in range(len(scene.effects)) if i not in omitted]
    return SceneSpec.model_construct(None, **values | scene.select_effect_fields(remaining))
