# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# JSON and YAML have no types.
"""Published fabrics: area density, membrane stiffness and flexural rigidity, and the range of plausible materials.

All values are measurements of Wang, O'Brien and Ramamoorthi (Data-driven elastic models for cloth, ACM Trans. Graph.
30(4), 2011). Membrane stiffness is that of small strains. Flexural rigidity is that of the least curvature, the
geometric mean of both directions, as for the overall rigidity of ASTM D1388; its range is that over all directions and
curvatures that were measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, WithJsonSchema
from springbench.harness.errors import format_allowed_names
from springbench.harness.schema.base_model import ConfigModel, Vector3

WANG_2011 = "Wang, O'Brien and Ramamoorthi 2011"
IMPLAUSIBLE_FACTOR = 100.0
"""Factor beyond the range of the table above which a material is probably a mistake."""


class PublishedFabric(NamedTuple):
    """A fabric of the table.

    Attributes:
        description: fibres and typical use.
        density: mass per area [kg/m^2].
        warp, weft: membrane stiffness along both threads [N/m], the larger one first.
        shear: membrane stiffness in shear, used along the bias [N/m].
        rigidity: flexural rigidity [N m].
        rigidity_range: smallest and largest measured flexural rigidity [N m].
        source: publication.
    """

    description: str
    density: float
    warp: float
    weft: float
    shear: float
    rigidity: float
    rigidity_range: tuple[float, float]
    source: str = WANG_2011


PUBLISHED_FABRICS: Mapping[str, PublishedFabric] = MappingProxyType(
    {
        "gray-interlock": PublishedFabric(
            "60 % cotton, 40 % polyester knit, T-shirts", 0.187, 34.5, 16.6, 36.9, 18.2e-6, (7.05e-6, 39.0e-6)
        ),
        "11oz-black-denim": PublishedFabric(
            "99 % cotton, 1 % spandex, jeans", 0.324, 1014.0, 205.0, 53.4, 78.9e-6, (19.8e-6, 120.6e-6)
        ),
        "white-dots-on-blk": PublishedFabric(
            "polyester, tablecloths", 0.128, 2027.0, 2002.0, 19.2, 40.2e-6, (10.4e-6, 66.4e-6)
        ),
        "royal-target": PublishedFabric(
            "65 % cotton, 35 % polyester, trousers", 0.220, 2035.0, 2017.0, 105.0, 125.4e-6, (108.0e-6, 227.9e-6)
        ),
        "camel-ponte-roma": PublishedFabric(
            "60 % polyester, 40 % rayon knit, jackets", 0.284, 44.0, 31.1, 31.9, 36.8e-6, (10.4e-6, 49.6e-6)
        ),
        "tango-red-jet-set": PublishedFabric(
            "polyester, jackets", 0.113, 171.0, 43.1, 14.3, 17.1e-6, (7.56e-6, 36.1e-6)
        ),
        "pink-ribbon-brown": PublishedFabric(
            "polyester, blankets", 0.228, 245.0, 152.0, 30.3, 83.7e-6, (36.4e-6, 298.6e-6)
        ),
    }
)
"""The fabrics by their names in the publication's data."""


def _check_name(name: str) -> str:
    find_fabric(name)
    return name


FabricName = Annotated[
    str, AfterValidator(_check_name), WithJsonSchema({"enum": list(PUBLISHED_FABRICS), "type": "string"})
]
"""Name of a published fabric."""


class FabricChoice(ConfigModel):
    """A published fabric and the direction of its warp."""

    name: FabricName
    """Name of a published fabric."""
    warp: Vector3 | None = None
    """Direction of the warp in the rest shape; without it the membrane is the same in all directions."""


def find_fabric(name: str) -> PublishedFabric:
    """Return a fabric of the table.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in PUBLISHED_FABRICS:
        raise ValueError(f"got {name[:60]!r}; should be {format_allowed_names(name, PUBLISHED_FABRICS)}")
    return PUBLISHED_FABRICS[name]


FABRIC_EFFECTS = ("springs", "bending")
"""Kinds of the effects that a fabric completes."""


def fill_effect(effect: Any, name: str, warp: Vector3 | None = None) -> Any:
    """Complete the data of an effect that states no material with a fabric's values.

    Args:
        effect: data of an effect as read from a scene; only FABRIC_EFFECTS have a material.
        name: name of the fabric.
        warp: direction of the warp in the rest shape, None for the same membrane stiffness in all directions.
    """
    if not isinstance(effect, dict):
        return effect
    data: dict[str, Any] = effect
    fabric = find_fabric(name)
    if data.get("kind") == "springs" and not data.keys() & {"stretch", "youngs_modulus"}:
        if warp is None:
            return {"shear": fabric.shear, **data, "stretch": (fabric.warp * fabric.weft) ** 0.5}
        weave = {"warp": fabric.warp, "weft": fabric.weft, "bias": fabric.shear, "direction": list(warp)}
        return {**data, "stretch": weave}
    if data.get("kind") == "bending" and not data.keys() & {"stiffness", "bending_length"}:
        return {**data, "stiffness": fabric.rigidity}
    return data


class PlausibleRange(NamedTuple):
    """Range of a quantity in the table.

    Attributes:
        quantity: name of the quantity, for messages.
        unit: unit of the quantity.
        low, high: smallest and largest value in the table.
        if_small, if_large: question about the likely mistake in a value far below or above the range.
    """

    quantity: str
    unit: str
    low: float
    high: float
    if_small: str
    if_large: str

    def describe_outlier(self, value: float) -> str:
        """Describe a value beyond the range by `IMPLAUSIBLE_FACTOR`; empty for a plausible one, or zero."""
        if value <= 0.0 or self.low / IMPLAUSIBLE_FACTOR <= value <= self.high * IMPLAUSIBLE_FACTOR:
            return ""
        guess = self.if_small if value < self.low else self.if_large
        return (
            f"a {self.quantity} of {value:.3g} {self.unit} is far from that of published fabrics, {self.low:.3g} to "
            f"{self.high:.3g} {self.unit}; {guess}"
        )


_FABRICS = tuple(PUBLISHED_FABRICS.values())
MEMBRANE_RANGE = PlausibleRange(
    "membrane stiffness",
    "N/m",
    min(x.weft for x in _FABRICS),
    max(x.warp for x in _FABRICS),
    "was it given in N/mm or kN/m?",
    "was it given in Pa? Then state `youngs_modulus` and `thickness`",
)
PRODUCT_RANGE = MEMBRANE_RANGE._replace(
    if_small="was `youngs_modulus` given in MPa or `thickness` in km?", if_large="was `thickness` given in mm?"
)
BENDING_RANGE = PlausibleRange(
    "flexural rigidity",
    "N m",
    min(x.rigidity_range[0] for x in _FABRICS),
    max(x.rigidity_range[1] for x in _FABRICS),
    "is it a Young's modulus times thickness cubed, in mm?",
    "was it given in uN m (1e-6 N m), gf cm^2/cm (9.8e-5 N m) or N/m?",
)
BENDING_LENGTH_RANGE = BENDING_RANGE._replace(
    if_small="was `bending_length` given in km?", if_large="was `bending_length` given in mm or cm?"
)
DENSITY_RANGE = PlausibleRange(
    "mass per area",
    "kg/m^2",
    min(x.density for x in _FABRICS),
    max(x.density for x in _FABRICS),
    "was it given in g/cm^2, or is the mass that of another size?",
    "was it given in g/m^2? 150 g/m^2 are 0.15 kg/m^2",
)
