"""Reference page of the Python API, from its docstrings and signatures."""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections import defaultdict
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from springbench.harness.cli.reference_pages.markdown_text import format_docstring

_INTRODUCTION = """# Python API

For authors of scripts, notebooks, solvers, effects, meshes, integrators and reports: every public name of
`import springbench`.

Names are imported on first use. Complete programs are in [configs/examples](../examples): a first simulation, and a
solver, an effect, a mesh and a report of one's own."""

_MATRICES = "Matrices and their factors"

_GROUPS = {
    "springbench.harness.api": "Scripts and notebooks",
    "springbench.harness.errors": "Errors",
    "springbench.solvers": "Interfaces of solvers",
    "springbench.solvers.model.integrators": "Interfaces of integrators",
    "springbench.solvers.linalg": _MATRICES,
    "springbench.solvers.model.system_matrix_assembly": _MATRICES,
    "springbench.harness": "Interfaces of scenes",
    "springbench.harness.report": "Interfaces of reports",
}
"""Titles by the longest prefix of the module of a name, in the order of the page."""
_MAX_SIGNATURE_WIDTH = 100
_VARIADIC, _KEYWORDS = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD


def build_api_page() -> str:
    """Build the page of all names of `springbench.__all__`."""
    library = import_module("springbench")  # no import statement: the command line does not depend on the API
    modules: dict[str, str] = vars(library)["_MODULE_OF"]
    grouped: dict[str, list[str]] = defaultdict(list)
    for name in library.__all__:
        prefixes = (prefix for prefix in _GROUPS if modules[name].startswith(prefix))
        grouped[_GROUPS[max(prefixes, key=len)]].append(name)
    parts = [_INTRODUCTION]
    for title in dict.fromkeys(_GROUPS.values()):
        parts.append(f"## {title}")
        parts += [_describe_name(name, getattr(library, name), modules[name]) for name in grouped[title]]
    return "\n\n".join(parts)


def _describe_name(name: str, value: Any, module: str) -> str:
    parts = [f"### {name}"]
    if inspect.isclass(value) and issubclass(value, BaseModel):
        value.model_rebuild()  # only a complete model has its own signature
    if inspect.isclass(value) or inspect.isfunction(value):
        parts += [_format_signature(name, value), format_docstring(value.__doc__)]
        if inspect.isclass(value):
            parts += _describe_members(value)
    else:
        parts.append(_read_alias_text(module, name))
    return "\n\n".join(part for part in parts if part)


def _describe_members(kind: type) -> list[str]:
    parts: list[str] = []
    for name, member in vars(kind).items():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        if name.startswith("_") or not inspect.isfunction(function) or not function.__doc__:
            continue
        shown = f"`{kind.__name__}.{name}`" if isinstance(member, property) else ""
        parts += [shown or _format_signature(f"{kind.__name__}.{name}", function), format_docstring(function.__doc__)]
    return parts


def _format_signature(name: str, value: Any) -> str:
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return ""
    parameters = [one for one in signature.parameters.values() if one.name not in ("self", "cls")]
    if inspect.isclass(value) and [one.kind for one in parameters] == [_VARIADIC, _KEYWORDS]:
        return ""
    if inspect.isclass(value) and not parameters:
        return ""
    shown = [_format_parameter(one) for one in parameters]
    kinds = [one.kind for one in parameters]
    if inspect.Parameter.KEYWORD_ONLY in kinds and _VARIADIC not in kinds:
        shown.insert(kinds.index(inspect.Parameter.KEYWORD_ONLY), "*")
    returned = "" if inspect.isclass(value) else _format_annotation(" -> ", signature.return_annotation)
    text = f"{name}({', '.join(shown)}){returned}"
    if len(text) > _MAX_SIGNATURE_WIDTH:
        text = f"{name}(\n" + "".join(f"    {one},\n" for one in shown) + f"){returned}"
    return f"```python\n{text}\n```"


def _format_parameter(parameter: inspect.Parameter) -> str:
    stars = {_VARIADIC: "*", _KEYWORDS: "**"}.get(parameter.kind, "")
    text = stars + parameter.name + _format_annotation(": ", parameter.annotation)
    return text if parameter.default is inspect.Parameter.empty else f"{text} = {parameter.default!r}"


def _format_annotation(sign: str, annotation: Any) -> str:
    if annotation is inspect.Signature.empty:
        return ""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    return sign + re.sub(r"\b(?:[A-Za-z_]\w*\.)+(?=[A-Z])", "", text)


def _read_alias_text(module: str, name: str) -> str:
    """Read the string below the definition of an alias.

    The definition is in the module, or in the one from which it imports the name.
    """
    tree = ast.parse(Path(str(sys.modules[module].__file__)).read_text(encoding="utf-8"))
    for node, below in pairwise(tree.body):
        targets = [ast.unparse(target) for target in getattr(node, "targets", ())]
        if name in targets and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            return inspect.cleandoc(str(below.value.value))
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and node.module and name in [alias.name for alias in node.names]:
            return _read_alias_text(node.module, name)
    return ""
