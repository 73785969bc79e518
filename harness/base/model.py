"""The base of every model that a config is checked against: frozen, and unknown keys are refused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, TypeVar, cast

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler
from pydantic_core import core_schema

Vector = tuple[float, float, float]
"""Three components x, y, z; y points up."""


class Model(BaseModel):
    """A frozen pydantic model; unknown keys are errors, infinities and NaN are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=False, allow_inf_nan=False, use_attribute_docstrings=True
    )


T = TypeVar("T")


class _OneOrMany:
    """Lets a single value stand for a list of one."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> core_schema.CoreSchema:
        def many(value: Any) -> tuple[Any, ...]:
            return (*cast(Sequence[Any], value),) if isinstance(value, list | tuple) else (value,)

        return core_schema.no_info_before_validator_function(many, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        array = handler(schema)
        return {"anyOf": [array["items"], array]}


Many = Annotated[tuple[T, ...], Field(min_length=1), _OneOrMany()]
