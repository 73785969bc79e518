"""Reading YAML: plain values with their lines, and mistakes that say where they are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from pydantic import Field
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.schema.base_model import ConfigModel, Vector3
from springbench.harness.schema.config_document import ConfigDocument, ConfigKey, format_key, parse_key, quote_value
from springbench.harness.schema.yaml_loader import read_yaml

VALUES = {
    "1e5": 100_000,
    "1E5": 100_000,
    "1e-3": 0.001,
    "-2.5e+3": -2500.0,
    ".5": 0.5,
    "1_000": 1000,
    "012": 12,
    "0o17": 15,
    "0xFF": 255,
    "+7": 7,
    "'1e5'": "1e5",
    "true": True,
    "yes": "yes",
    "off": "off",
    "~": None,
    "": None,
    "1:30": "1:30",
    "1/30": "1/30",
    "2020-01-01": "2020-01-01",
    "!!str 5": "5",
    "[1, [2]]": [1, [2]],
    "{a: {b: c}}": {"a": {"b": "c"}},
}


def read(folder: Path, text: str) -> ConfigDocument:
    path = folder / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return read_yaml(path)


@pytest.mark.parametrize(("written", "value"), VALUES.items(), ids=repr)
def test_a_value_is_read_as_yaml_1_2_means_it(tmp_path: Path, written: str, value: object) -> None:
    data = read(tmp_path, f"key: {written}\n").data
    assert data == {"key": value}
    assert type(data["key"]) is type(value)


@pytest.mark.parametrize("written", [".inf", "-.Inf", ".NAN", "1e999"])
def test_a_number_that_is_not_finite_is_read_and_left_to_the_model_to_refuse(tmp_path: Path, written: str) -> None:
    value = read(tmp_path, f"key: {written}\n").data["key"]
    assert isinstance(value, float)
    assert value - value != 0  # inf - inf and nan - nan are nan


def test_every_key_and_item_has_its_line(tmp_path: Path) -> None:
    lines = read(tmp_path, "a: 1\n\nb:\n  - c: 2\n    d: 3\n  -\n    5\n").lines
    assert {format_key(key): line for key, line in lines.items() if key} == {
        "a": 1,
        "b": 3,
        "b[0]": 4,
        "b[0].c": 4,
        "b[0].d": 5,
        "b[1]": 7,
    }


def test_an_alias_repeats_its_value(tmp_path: Path) -> None:
    assert read(tmp_path, "a: &a [1, 2]\nb: *a\n").data == {"a": [1, 2], "b": [1, 2]}


def test_a_byte_order_mark_is_passed_over(tmp_path: Path) -> None:
    assert read(tmp_path, "\ufeffa: 1\n").data == {"a": 1}


class Inner(ConfigModel):
    width: float = 1.0


class Ball(ConfigModel):
    kind: Literal["ball"] = "ball"
    radius: float = 1.0


class Brick(ConfigModel):
    kind: Literal["brick"] = "brick"
    sides: Vector3 = (1.0, 1.0, 1.0)


class Outer(ConfigModel):
    count: int
    toy: tuple[Annotated[Ball | Brick, Field(discriminator="kind")], ...] = ()
    place: Vector3 = (0.0, 0.0, 0.0)
    weight: float | Literal["exact"] = 1.0
    inner: Inner | None = None


CHECKS: dict[str, tuple[dict[str, Any], list[str]]] = {
    "missing key": ({"place": [0, 0, 0]}, ["c.yaml:4: part.count: is missing"]),
    "boolean as integer": ({"count": True}, ["c.yaml:5: part.count: got true; should be a valid integer"]),
    "text as integer": ({"count": "3"}, ['c.yaml:5: part.count: got "3"; should be a valid integer']),
    "fraction as integer": ({"count": 3.5}, ["c.yaml:5: part.count: got 3.5; should be a valid integer"]),
    "short list": ({"count": 1, "place": [0, 1]}, ["c.yaml:4: part.place: has too few items"]),
    "item": ({"count": 1, "place": [0, 1, "z"]}, ['c.yaml:4: part.place[2]: got "z"; should be a valid number']),
    "member of a union": (
        {"count": 1, "weight": "x"},
        ["c.yaml:4: part.weight: got \"x\"; should be a valid number or 'exact'"],
    ),
    "unknown key": (
        {"count": 1, "wight": 2},
        ["c.yaml:4: part.wight: unknown key; expected one of count, inner, place, toy, weight; did you mean 'weight'?"],
    ),
    "unknown key further in": (
        {"count": 1, "inner": {"x": 2}},
        ["c.yaml:4: part.inner.x: unknown key; expected one of width"],
    ),
    "unknown key of one kind of several": (
        {"count": 1, "toy": [{"kind": "ball", "radus": 1}, {"kind": "brick", "side": 1}]},
        [
            "c.yaml:4: part.toy[0].radus: unknown key; expected one of kind, radius; did you mean 'radius'?",
            "c.yaml:4: part.toy[1].side: unknown key; expected one of kind, sides; did you mean 'sides'?",
        ],
    ),
    "two mistakes": (
        {"count": 0.5, "inner": 3},
        [
            "c.yaml:4: part.inner: got 3; should be an object",
            "c.yaml:5: part.count: got 0.5; should be a valid integer",
        ],
    ),
}


@pytest.mark.parametrize("case", CHECKS)
def test_each_mistake_names_its_key_and_the_nearest_line(case: str) -> None:
    data, expected = CHECKS[case]
    lines: dict[ConfigKey, int] = {("part", "count"): 5} if "count" in data else {}
    document = ConfigDocument(Path("c.yaml"), {"part": data}, {(): 1, ("part",): 4, **lines})
    assert document.validate_data(Outer, data, ("part",)) is None
    assert list(map(str, document.build_error().mistakes)) == expected


@pytest.mark.parametrize("key", ["", "mass", "effects[2]", "effects[2].weight", "options.rtol[0]"])
def test_a_formatted_key_is_parsed(key: str) -> None:
    assert format_key(parse_key(key)) == key


def test_the_mistake_of_an_error_gets_the_line_of_its_key() -> None:
    document = ConfigDocument(Path("c.yaml"), {}, {("effects",): 2, ("effects", 0): 3, ("effects", 1): 7})
    document.add_errors(InputError(InputMistake("is negative", key="effects[1].weight")))
    assert list(map(str, document.mistakes)) == ["c.yaml:7: effects[1].weight: is negative"]


def test_a_valid_mapping_becomes_its_model() -> None:
    document = ConfigDocument(Path("c.yaml"), {})
    outer = document.validate_data(Outer, {"count": 3, "place": [0, 1, 2], "weight": "exact", "inner": {"width": 2}})
    assert outer == Outer(count=3, place=(0.0, 1.0, 2.0), weight="exact", inner=Inner(width=2.0))
    assert not document.mistakes


def test_a_long_value_is_quoted_short() -> None:
    assert quote_value("x" * 1000) == '"' + "x" * 56 + "..."


def test_aliases_that_multiply_are_refused_before_they_fill_the_memory(tmp_path: Path) -> None:
    bomb = "a0: &a0 [0, 0]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n" for i in range(1, 30))
    with pytest.raises(InputError, match="too large"):
        read(tmp_path, bomb)
