"""The base of every model that a config is checked against: frozen, and unknown keys are refused."""

from pydantic import BaseModel, ConfigDict

Vector = tuple[float, float, float]
"""Three components x, y, z; y points up."""


class Model(BaseModel):
    """A frozen pydantic model; unknown keys are errors, infinities and NaN are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=False, allow_inf_nan=False, use_attribute_docstrings=True
    )
