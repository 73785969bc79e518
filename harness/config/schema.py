"""JSON Schema (draft 2020-12) of all configs, generated from their models.

Configs are scenes, sweeps, accuracy configs and performance targets. Editors use it for completion and validation.
"""

from __future__ import annotations

from functools import reduce
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, create_model
from pydantic.json_schema import models_json_schema

from harness.base.model import Model
from harness.config.accuracy import AccuracyFields
from harness.config.goals import GoalsFields
from harness.config.solvers import parameters_model
from harness.config.sweep import SweepFields
from harness.scenes.effects.effect_names import EFFECTS
from harness.scenes.mesh.mesh_names import MESHES
from harness.scenes.spec import SceneFile
from solvers.plugins import PATTERN
from solvers.registry import OPTIONAL, SOLVERS, load


def schema() -> dict[str, Any]:
    """Build the schema of all kinds of configs; it lists every mesh, effect and solver."""
    mesh = _one_of({kind: load(target) for kind, target in MESHES.items()}, "kind")
    effect = _one_of({kind: load(target) for kind, target in EFFECTS.items()}, "kind")
    shipped = {**SOLVERS, **OPTIONAL}
    solver = _one_of({name: parameters_model(name, load(target)) for name, target in shipped.items()}, "name")
    known: Any = Literal[tuple(shipped)]
    names: Any = known | Annotated[str, Field(pattern=PATTERN)]
    scene = create_model(
        "Scene",
        __base__=SceneFile,
        mesh=(mesh, ...),
        effects=(list[effect], []),  # pyright: ignore[reportInvalidTypeForm]
    )
    listed: Any = list[names | solver]  # pyright: ignore[reportInvalidTypeForm]
    others = [
        create_model(name, __base__=base, solvers=(listed, ...))
        for name, base in (("Sweep", SweepFields), ("Accuracy", AccuracyFields))
    ]
    models = (scene, *others, GoalsFields)
    _, document = models_json_schema([(model, "validation") for model in models])
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "springbench config",
        "oneOf": [{"$ref": f"#/$defs/{model.__name__}"} for model in models],
        **document,
    }


def _one_of(models: dict[str, type[Model]], tag: str) -> Any:
    """Build a union of models, discriminated by a required key.

    The key has the name of the model.
    """
    make: Any = create_model  # the name of a field is known at run time alone
    tagged: list[Any] = [
        make(name, __base__=model, __doc__=model.__doc__, **{tag: (Literal[name], ...)})
        for name, model in models.items()
    ]
    own: Any = make(  # its keys are known to its code alone, which nobody runs for a schema
        f"Own {tag}",
        __config__=ConfigDict(extra="allow"),
        __doc__="Your own: `module:Name`, or `./file.py:Name` beside the config.",
        **{tag: (Annotated[str, Field(pattern=PATTERN)], ...)},
    )
    return Annotated[reduce(lambda one, other: one | other, tagged), Field(discriminator=tag)] | own
