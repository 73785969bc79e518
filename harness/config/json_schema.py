"""JSON Schema (draft 2020-12) of all configs, generated from their models.

Configs are scenes, sweeps and accuracy configs. Editors use it for completion and validation.
"""

from __future__ import annotations

from functools import reduce
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, create_model
from pydantic.json_schema import models_json_schema
from springbench.harness.config.accuracy_config import AccuracyConfig
from springbench.harness.config.solver_parameters import build_parameter_model
from springbench.harness.config.sweep_config import SweepConfig
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.mesh.mesh_table import MESH_CLASSES
from springbench.harness.scenes.scene_spec import SceneFile
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.plugins.plugin_discovery import PLUGIN_PATTERN
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, load_target


def build_json_schema() -> dict[str, Any]:
    """Build the schema of all kinds of configs; it lists every mesh, effect and solver."""
    mesh = _build_tagged_union({kind: load_target(target) for kind, target in MESH_CLASSES.items()}, "kind")
    effect = _build_tagged_union({kind: load_target(target) for kind, target in EFFECT_CLASSES.items()}, "kind")
    shipped = {**SOLVERS, **OPTIONAL_SOLVERS}
    solver = _build_tagged_union(
        {name: build_parameter_model(name, load_target(target)) for name, target in shipped.items()}, "name"
    )
    known: Any = Literal[tuple(shipped)]
    names: Any = known | Annotated[str, Field(pattern=PLUGIN_PATTERN)]
    scene = create_model(
        "Scene",
        __base__=SceneFile,
        mesh=(mesh, ...),
        effects=(list[effect], []),  # pyright: ignore[reportInvalidTypeForm]
    )
    listed: Any = list[names | solver]  # pyright: ignore[reportInvalidTypeForm]
    others = [
        create_model(name, __base__=base, solvers=(listed, ...))
        for name, base in (("Sweep", SweepConfig), ("Accuracy", AccuracyConfig))
    ]
    models = (scene, *others)
    _, document = models_json_schema([(model, "validation") for model in models])
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "springbench config",
        "oneOf": [{"$ref": f"#/$defs/{model.__name__}"} for model in models],
        **document,
    }


def _build_tagged_union(models: dict[str, type[ConfigModel]], tag: str) -> Any:
    """Build a union of models, discriminated by a required key.

    The key has the name of the model.
    """
    make: Any = create_model  # untyped, because the name of the field is known only at run time
    tagged: list[Any] = [
        make(name, __base__=model, __doc__=model.__doc__, **{tag: (Literal[name], ...)})
        for name, model in models.items()
    ]
    own: Any = make(  # any key is allowed: the keys are defined in user code, which a schema does not run
        f"Own {tag}",
        __config__=ConfigDict(extra="allow"),
        __doc__="Your own: `module:Name`, or `./file.py:Name` next to the config.",
        **{tag: (Annotated[str, Field(pattern=PLUGIN_PATTERN)], ...)},
    )
    return Annotated[reduce(lambda one, other: one | other, tagged), Field(discriminator=tag)] | own
