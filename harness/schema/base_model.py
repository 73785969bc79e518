"""Base of all config models: frozen, and unknown keys are errors.

The string below a field is its description. Sources are parsed for descriptions only on request, for example for the
JSON Schema; validation of a config does not need them.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Sequence
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler
from pydantic_core import core_schema

Vector3 = tuple[float, float, float]
"""Three components x, y, z; y points up."""


class ConfigModel(BaseModel):
    """A frozen pydantic model that rejects unknown keys, infinities and NaN.

    Example:
        >>> class Drag(springbench.ConfigModel):
        ...     coefficient: float
        >>> Drag(coefficient=0.1)
        Drag(coefficient=0.1)
        >>> Drag(coefficient=0.1, density=1.2)
        Traceback (most recent call last):
        pydantic_core._pydantic_core.ValidationError: 1 validation error for Drag
        ...
    """

    # A deferred model is built when it is used first: most are bases or parts of others, and are never used themselves.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, allow_inf_nan=False, defer_build=True)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        schema = handler(core_schema)
        fields = handler.resolve_ref_schema(schema).get("properties", {})
        for name, says in read_field_descriptions(cls).items():
            if name in fields:
                fields[name].setdefault("description", says)
        return schema


def read_field_descriptions(model: type[ConfigModel]) -> dict[str, str]:
    """Read the descriptions of the fields of a model, including inherited ones."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        file = getattr(sys.modules.get(base.__module__), "__file__", None)
        if issubclass(base, ConfigModel) and file:
            found |= _parse_field_descriptions(file).get(base.__qualname__, {})
    return found


@cache
def _parse_field_descriptions(file: str) -> dict[str, dict[str, str]]:
    """Parse the strings below the fields of each class of a source file."""
    with open(file, encoding="utf-8") as source:
        classes = [node for node in ast.parse(source.read()).body if isinstance(node, ast.ClassDef)]
    return {
        made.name: {
            field.target.id: inspect.cleandoc(below.value.value)
            for field, below in pairwise(made.body)
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
            if isinstance(below.value.value, str)
        }
        for made in classes
    }


T = TypeVar("T")


class _ScalarAsTuple:
    """Validator that accepts a single value for a tuple of one."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        def convert_to_tuple(value: Any) -> tuple[Any, ...]:
            return (*cast(Sequence[Any], value),) if isinstance(value, list | tuple) else (value,)

        return core_schema.no_info_before_validator_function(convert_to_tuple, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        array = handler(schema)
        return {"anyOf": [array["items"], array]}


OneOrMany = Annotated[tuple[T, ...], Field(min_length=1), _ScalarAsTuple()]
