"""Curves as drawings: each in its own colour, however many there are."""

from __future__ import annotations

from typing import Any, cast

import pytest
import rerun as rr
from springbench.harness.recording import curve_drawing


class LogStream:
    """A stream that records what is logged."""

    def __init__(self) -> None:
        self.logged_data: dict[str, Any] = {}

    def log(self, entity: str, drawn: Any, *, static: bool) -> None:
        self.logged_data[entity] = drawn


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
def test_each_curve_and_its_name_have_its_colour(count: int) -> None:
    given = [0xE69F00FF, 0x56B4E9FF, 0x009E73FF, 0xCC79A7FF, 0xF0E442FF][:count]
    logged = LogStream()
    drawn = {f"frame {k}": [1.0, 0.1 / (k + 1)] for k in range(count)}
    curve_drawing.draw_curves(cast(rr.RecordingStream, logged), "/curves", drawn, curve_drawing.pack_colours(given))
    for entity in ("/curves/lines", "/curves/words"):
        assert logged.logged_data[entity].colors.as_arrow_array().to_pylist()[-count:] == given
