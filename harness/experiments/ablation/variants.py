"""The variants of a scene that are compared: the whole one, and without each effect or each pair of them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations

from harness.scenes.spec import SceneSpec


@dataclass(frozen=True, slots=True, eq=False)
class Variant:
    """A scene without the effects `left_out`, by name; none are left out of the whole scene."""

    left_out: tuple[str, ...]
    scene: SceneSpec

    @property
    def name(self) -> str:
        """The effects left out, joined by +."""
        return "+".join(self.left_out)


def variants(scene: SceneSpec, *, pairs: bool) -> list[Variant]:
    """The whole scene, then without each of its effects in their order; with `pairs` also without each two."""
    names = effect_names(scene)
    chosen: list[tuple[int, ...]] = [(), *((i,) for i in range(len(names)))]
    if pairs:
        chosen += combinations(range(len(names)), 2)
    return [Variant(tuple(names[i] for i in out), _without(scene, out)) for out in chosen]


def effect_names(scene: SceneSpec) -> list[str]:
    """Each effect's kind; where a scene lists two of a kind, with their places in the list."""
    count = Counter(effect.kind for effect in scene.effects)
    return [e.kind if count[e.kind] == 1 else f"{e.kind}[{i}]" for i, e in enumerate(scene.effects)]


def _without(scene: SceneSpec, out: tuple[int, ...]) -> SceneSpec:
    values = {key: getattr(scene, key) for key in SceneSpec.model_fields}
    kept = [i for i in range(len(scene.effects)) if i not in out]
    return SceneSpec.model_construct(None, **values | scene.of_effects(kept))
