"""Variants of a scene: the full one, and without each effect or pair."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations

from harness.scenes.spec import SceneSpec


@dataclass(frozen=True, slots=True, eq=False)
class Variant:
    """Scene without the effects `left_out`, by name; the full scene omits none."""

    left_out: tuple[str, ...]
    scene: SceneSpec

    @property
    def name(self) -> str:
        """The omitted effects, joined by +."""
        return "+".join(self.left_out)


def variants(scene: SceneSpec, *, pairs: bool) -> list[Variant]:
    """Build the full scene, then one variant without each effect in order; `pairs` adds pairs."""
    names = effect_names(scene)
    chosen: list[tuple[int, ...]] = [(), *((i,) for i in range(len(names)))]
    if pairs:
        chosen += combinations(range(len(names)), 2)
    return [Variant(tuple(names[i] for i in out), _without(scene, out)) for out in chosen]


def effect_names(scene: SceneSpec) -> list[str]:
    """Return the name of each effect.

    It is the kind, with the index in the list where a scene lists two of a kind.
    """
    count = Counter(effect.kind for effect in scene.effects)
    return [e.kind if count[e.kind] == 1 else f"{e.kind}[{i}]" for i, e in enumerate(scene.effects)]


def _without(scene: SceneSpec, out: tuple[int, ...]) -> SceneSpec:
    values = {key: getattr(scene, key) for key in SceneSpec.model_fields}
    kept = [i for i in range(len(scene.effects)) if i not in out]
    return SceneSpec.model_construct(None, **values | scene.of_effects(kept))
