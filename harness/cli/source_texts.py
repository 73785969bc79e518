"""Texts that depend only on the sources: names, and the JSON Schema.

They are printed without Typer, whose import takes longer.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from springbench.harness.execution.source_cache import read_cached_text
from springbench.solvers.plugins.plugin_discovery import list_entry_points


def print_schema() -> None:
    """Print the JSON Schema of scenes and sweeps."""
    print(read_cached_text("schema", _build_schema_text))


def _build_schema_text() -> str:
    import json

    from springbench.harness.config.json_schema import build_json_schema

    return json.dumps(build_json_schema(), indent=2)


def print_names() -> None:
    """Print the names of all solvers, integrators, effects and meshes."""
    print(read_cached_text("names", _describe_names, repr(list_entry_points())))


def _describe_names() -> str:
    from springbench.harness.scenes.effects.effect_table import EFFECT_TABLE as EFFECTS
    from springbench.harness.scenes.mesh.mesh_table import MESH_TABLE as MESHES
    from springbench.solvers.model.integrators import INTEGRATOR_TABLE as INTEGRATORS
    from springbench.solvers.registry import SOLVER_TABLE as SOLVERS

    kinds: dict[str, Mapping[str, Any]] = {
        "solvers": SOLVERS,
        "integrators": INTEGRATORS,
        "effects": EFFECTS,
        "meshes": MESHES,
    }
    text: list[str] = []
    for heading, table in kinds.items():
        text.append(f"\n{heading}, {len(table)}")
        lines = [(f"  {name}", _read_summary(target)) for name, target in table.items()]
        width = max(len(name) for name, _ in lines)
        text += [f"{name:{width}}  {summary}".rstrip() for name, summary in lines]
    return "\n".join(
        [
            *text,
            "\nconfigs/reference/solvers.md describes each solver, configs/README.md the rest; "
            "`springbench schema` has all parameters",
        ]
    )


def _read_summary(target: Any) -> str:
    """Read the first sentence of a class docstring from the source.

    Importing a solver would compile kernels.
    """
    if not isinstance(target, str):
        from springbench.solvers.model.integrators import SUBSTEPPING

        return "for solvers that integrate a step by themselves" if target is SUBSTEPPING else f"order {target.order}"
    module, _, name = target.partition(":")
    spec = find_spec(module)
    if spec is None or not spec.origin:
        return ""
    source = Path(spec.origin).read_text(encoding="utf-8")  # `ast` would take 0.25 s for all of them
    of_class = re.search(rf'^class {name}\b[^"#]*?:\n    r?"""(.*?)"""', source, re.M | re.S)
    docstring = of_class[1] if of_class else ""
    # A class docstring that starts with its parameters leaves the description to the module docstring.
    if docstring[:1].islower() and (of_module := re.match(r'r?"""(.*?)"""', source, re.S)):
        docstring = of_module[1]
    return _extract_first_sentence(docstring)


def _extract_first_sentence(text: str) -> str:
    return re.split(r"(?<!et al)\.(?=\s|$)|[:;]\s|\s\(", " ".join(text.split()), maxsplit=1)[0]
