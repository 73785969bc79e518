"""The looks of solvers in all pictures: distinct, also to the colour-blind, and visible on every ground."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv, to_rgb
from springbench.harness.recording.viewer_blueprint import BACKGROUND
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    assign_solver_styles,
)
from springbench.harness.report.site.plotly_styles import build_plotly_style
from springbench.solvers.registry import SOLVER_TABLE, find_solver_info, load_target

# Machado, Oliveira and Fernandes 2009, "A Physiologically-based Model for Simulation of Color Vision Deficiency",
# severity 1: what people without one kind of cone see of linear RGB.
BLINDNESS = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "full sight": np.eye(3).tolist(),
}


def lab(color: str, matrix: list[list[float]] = BLINDNESS["full sight"]) -> np.ndarray:
    """Return CIELAB of a color as a viewer sees it, but for its linear part near black."""
    rgb = np.array(to_rgb(color))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ np.clip(
        np.array(matrix) @ linear, 0, 1
    )
    x, y, z = np.cbrt(xyz / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("matrix", BLINDNESS.values(), ids=[*BLINDNESS])
def test_solvers_differ_in_colour_or_line_to_the_colour_blind_too(matrix: list[list[float]]) -> None:
    for (a, one), (b, other) in combinations(assign_solver_styles([]).items(), 2):
        apart = float(np.linalg.norm(lab(one.color, matrix) - lab(other.color, matrix)))
        # 10 is five times a just noticeable difference of CIELAB.
        assert apart > 10 or one.dash != other.dash, f"{a} and {b}: {apart:.1f}"


def test_families_are_far_apart_and_members_of_one_differ_in_lightness_line_and_marker() -> None:
    """Also in what the page makes of the styles."""
    looks = assign_solver_styles([])
    family = {name: find_solver_info(load_target(SOLVER_TABLE[name]), name).family for name in looks}
    for (a, one), (b, other) in combinations(looks.items(), 2):
        apart = float(np.linalg.norm(lab(one.color) - lab(other.color)))
        if family[a] != family[b]:
            assert apart >= 25.0, f"{a} and {b}: {apart:.1f}"
            continue
        assert apart >= 7.5, f"{a} and {b}: {apart:.1f}"
        assert one.dash != other.dash
        assert one.marker != other.marker
        shown, neighbour = build_plotly_style(one), build_plotly_style(other)
        assert shown["dash"] != neighbour["dash"]
        assert shown["symbol"] != neighbour["symbol"]


def luminance(color: Sequence[float]) -> float:
    rgb = np.array(color)
    return float(np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("name", [*SOLVER_TABLE, *(f"a stranger {k}" for k in range(12))])
def test_one_style_is_visible_on_the_light_page_and_on_the_dark_ground_of_the_viewer(name: str) -> None:
    color = luminance(to_rgb(assign_solver_styles([name])[name].color))
    page, ground = luminance(to_rgb(BACKGROUND_COLOUR)), luminance([part / 255 for part in BACKGROUND])
    # Contrast as the W3C defines it; 1.5 is that of a hairline, and lines are thick.
    assert (page + 0.05) / (color + 0.05) > 1.5
    assert (color + 0.05) / (ground + 0.05) > 1.5


def test_every_solver_has_a_style_and_a_marker_of_its_own() -> None:
    looks = assign_solver_styles([])
    assert set(looks) == set(SOLVER_TABLE)
    assert len({look.marker for look in looks.values()}) == len(looks)


def test_solvers_of_a_family_have_one_hue() -> None:
    hues: dict[str, set[int]] = {}
    for name, look in assign_solver_styles([]).items():
        hue, saturation, _ = rgb_to_hsv(to_rgb(look.color))
        hues.setdefault(find_solver_info(load_target(SOLVER_TABLE[name]), name).family, set()).add(
            round(360 * hue) if saturation > 0.1 else -1
        )
    # Two hexadecimal digits round a hue by a degree or two.
    assert all(max(found) - min(found) <= 3 for found in hues.values())
