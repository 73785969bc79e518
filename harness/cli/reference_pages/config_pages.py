# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# JSON and YAML have no types.
"""Reference pages of config keys, meshes and effects, from the JSON Schema of all configs."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterable, Mapping
from typing import Any

from springbench.harness.cli.reference_pages.markdown_text import build_anchor, format_docstring, format_table
from springbench.harness.config.json_schema import build_json_schema
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES
from springbench.harness.scenes.mesh.mesh_table import MESH_CLASSES
from springbench.solvers.plugins.plugin_discovery import PLUGIN_PATTERN
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, load_target

Schema = Mapping[str, Any]

CONFIG_PAGE, MESH_PAGE, EFFECT_PAGE = "config-keys.md", "meshes.md", "effects.md"
_DOCUMENTS = {"Sweep": "Sweep", "SweepOptions": "Options", "Accuracy": "Accuracy study", "Scene": "Scene"}
"""Titles of the parts that come first on the page of keys."""

_INTRODUCTIONS = {
    CONFIG_PAGE: """# Config keys

For writers of sweeps, accuracy studies and scenes: every key with its type, its default and its meaning.

`springbench schema` prints the JSON Schema that editors use to complete and check them. Each mistake in a file is
reported with its line. Kinds of [meshes](meshes.md), [effects](effects.md) and [solvers](solvers.md) have pages of
their own.""",
    MESH_PAGE: """# Meshes

For writers of scenes: every kind of mesh with its keys, its parts and its springs.

`mesh: {kind: grid, width: 1.5}` selects a kind. The mesh size is one number, `size`, from the sweep or the scene.""",
    EFFECT_PAGE: """# Effects

For writers of scenes: every effect with its formula, its keys and its units.

A scene lists its effects, `effects: [{kind: gravity}, ...]`; an effect that is not listed is not simulated.""",
}
_MAX_LISTED_NAMES = 12


def build_config_pages() -> dict[str, str]:
    """Build the pages of config keys, of meshes and of effects, by file name."""
    definitions = build_json_schema()["$defs"]
    kinds = {CONFIG_PAGE: _list_shared(definitions), MESH_PAGE: list(MESH_CLASSES), EFFECT_PAGE: list(EFFECT_CLASSES)}
    places = {name: page for page, names in kinds.items() for name in names}
    pages = {}
    for page, names in kinds.items():
        writer = SchemaWriter(definitions, places, page)
        parts = [_INTRODUCTIONS[page], writer.list_sections(names), *map(writer.describe_definition, names)]
        pages[page] = "\n\n".join(parts)
    return pages


def _list_shared(definitions: Schema) -> list[str]:
    excluded = {*MESH_CLASSES, *EFFECT_CLASSES, *SOLVERS, *OPTIONAL_SOLVERS, *_DOCUMENTS, "Own_kind", "Own_name"}
    return [
        *_DOCUMENTS,
        *(name for name in definitions if name not in excluded and not _find_mesh_kind(definitions[name])),
    ]


def _find_mesh_kind(definition: Schema) -> str:
    """Return the kind of a mesh class that is also defined under its kind, else ""."""
    kind = definition.get("properties", {}).get("kind", {}).get("const", "")
    return kind if kind in MESH_CLASSES and definition["title"].endswith("Mesh") else ""


class SchemaWriter:
    """Writes definitions of a JSON Schema as sections of one page."""

    def __init__(self, definitions: Schema, places: Mapping[str, str], page: str) -> None:
        self._definitions, self._places, self._page = definitions, places, page

    def list_sections(self, names: Iterable[str]) -> str:
        """List links to the sections of the page."""
        return ", ".join(self._link(name) for name in names) + "."

    def describe_definition(self, name: str) -> str:
        """Describe a definition: its text, and a table of its keys."""
        definition = self._definitions[name]
        required = definition.get("required", ())
        rows = [
            (f"`{key}`", self.format_type(one), format_default(one, key in required), one.get("description", ""))
            for key, one in definition.get("properties", {}).items()
            if not (key == "kind" and self._page != CONFIG_PAGE)
        ]
        parts = [f"## {_DOCUMENTS.get(name, name)}"]
        if self._page == EFFECT_PAGE:
            parts += _describe_formula(load_target(EFFECT_CLASSES[name]))
        parts.append(definition.get("description", ""))
        parts.append(format_table(("key", "type", "default", "meaning"), rows) if rows else "It has no keys.")
        return "\n\n".join(part for part in parts if part)

    def _link(self, name: str) -> str:
        name = _find_mesh_kind(self._definitions[name]) or name
        page = self._places.get(name, self._page)
        title = _DOCUMENTS.get(name, name)
        return f"[{title}]({'' if page == self._page else page}#{build_anchor(title)})"

    def format_type(self, schema: Schema) -> str:
        """Format the type of a key, with links to the sections of other definitions."""
        if "$ref" in schema:
            name = schema["$ref"].rpartition("/")[2]
            if name in SOLVERS or name in OPTIONAL_SOLVERS:
                return "[solver](solvers.md)"
            return "`module:Name`" if name.startswith("Own_") else self._link(name)
        if "const" in schema:
            return f"`{schema['const']}`"
        if "enum" in schema:
            return self._format_names(schema["enum"])
        if options := schema.get("anyOf") or schema.get("oneOf"):
            return self._format_union(options)
        return self._format_plain(schema)

    def _format_union(self, options: Iterable[Schema]) -> str:
        listed = list(options)
        names = {one["$ref"].rpartition("/")[2] for one in listed if "$ref" in one}
        for table, text in ((MESH_CLASSES, "[mesh](meshes.md)"), (EFFECT_CLASSES, "[effect](effects.md)")):
            if names and set(table) <= names:
                return f"{text} or `module:Name`"
        single, last = listed[:-1], listed[-1]
        if last.get("type") == "array" and [last.get("items")] == single:  # a value, or a list of such values
            return f"{self.format_type(single[0])}, or a list of these"
        return " or ".join(dict.fromkeys(map(self.format_type, listed)))

    def _format_names(self, names: list[str]) -> str:
        if set(SOLVERS) <= set(names):
            return "[name of a solver](solvers.md)"
        shown = [f"`{name}`" for name in names[:_MAX_LISTED_NAMES]]
        return " or ".join(shown) + (" or ..." if len(names) > _MAX_LISTED_NAMES else "")

    def _format_plain(self, schema: Schema) -> str:
        kind = schema.get("type", "")
        if kind == "array":
            if items := schema.get("prefixItems"):
                kinds = list(dict.fromkeys(self.format_type(one) for one in items))
                return (
                    f"{len(items)} × {kinds[0]}" if len(kinds) == 1 else f"[{', '.join(map(self.format_type, items))}]"
                )
            return f"list of {self.format_type(schema['items'])}" if "items" in schema else "list"
        if kind in ("number", "integer"):
            return " ".join(["number" if kind == "number" else "integer", _format_bounds(schema)]).strip()
        if kind == "string" and schema.get("pattern") == PLUGIN_PATTERN:
            return "`module:Name`"
        return {"string": "text", "boolean": "true or false", "object": "mapping", "": "any"}.get(kind, kind)


def _describe_formula(effect: Any) -> list[str]:
    """Return the module docstring of an effect (formula and source) and its limit of the order."""
    order = getattr(effect, "max_convergence_order", math.inf)
    limit = "" if order == math.inf else f"Every integrator has at most order {order:g} with it."
    return [format_docstring(sys.modules[effect.__module__].__doc__), limit]


def format_default(schema: Schema, is_required: bool) -> str:
    """Format the default of a key for the table of keys.

    Args:
        schema: JSON Schema of the key.
        is_required: whether a config must have the key.

    Returns:
        `required`, or the default as JSON; empty if there is none, or if it is a mapping, whose keys have their own
        defaults.
    """
    default = schema.get("default")
    if is_required or "default" not in schema or isinstance(default, dict):
        return "required" if is_required else ""
    return f"`{json.dumps(default, ensure_ascii=False)}`"


def _format_bounds(schema: Schema) -> str:
    signs = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    found = [f"{sign} {schema[key]:g}" for key, sign in signs.items() if key in schema]
    return re.sub(r"e([+-])0*(\d)", lambda m: f"e{m[1].strip('+')}{m[2]}", ", ".join(found))
