"""A scene as it starts: which vertices its effects choose, in words and in colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from springbench.harness.cli.main import app
from springbench.harness.report import opengl_probe
from springbench.harness.report.plot_style import build_indexed_style
from typer.testing import CliRunner

SCENE = """
mesh: {kind: grid, plane: vertical}
mass: 0.3
time_step: 1/30
frames: 2
default_size: 5
effects:
  - {kind: springs, stretch: 100}
  - {kind: pins, parts: [top_corners]}
  - {kind: sewing, first_row: {parts: [left]}, second_row: {parts: [right], stride: 2}, stiffness: 10}
"""


@pytest.mark.skipif(opengl_probe.find_opengl_problem() is not None, reason=opengl_probe.find_opengl_problem() or "")
def test_the_chosen_settings_are_printed_and_drawn(tmp_path: Path):
    (tmp_path / "cloth.yaml").write_text(SCENE)
    picture = tmp_path / "cloth.png"
    result = CliRunner().invoke(app, ["preview", str(tmp_path / "cloth.yaml"), "-o", str(picture)])
    assert result.exit_code == 0, result.output
    lines = " ".join(result.output.split())
    assert "effects[1] pins: 2 vertices (parts (top_corners)): 0, 4" in lines
    assert "effects[2] sewing: second_row: 3 vertices (parts (right), stride 2): 4, 14, 24" in lines
    assert "boundary loops (boundary_loops): 0: 4 m" in lines
    with Image.open(picture) as drawn:
        pixels = np.asarray(drawn.convert("RGB"), np.float64) / 255
    hue = pixels - pixels.mean(axis=2, keepdims=True)
    for k in range(3):  # lit from one side, so lighter and darker: by its hue
        colour = np.array(to_rgb(build_indexed_style(k).color))
        expected = colour - colour.mean()
        alike = (hue @ expected) / np.maximum(np.linalg.norm(hue, axis=2) * np.linalg.norm(expected), 1e-9)
        assert int(((alike > 0.98) & (np.linalg.norm(hue, axis=2) > 0.3)).sum()) > 100


def test_a_file_that_is_not_a_picture_is_refused(tmp_path: Path):
    (tmp_path / "cloth.yaml").write_text(SCENE)
    result = CliRunner().invoke(app, ["preview", str(tmp_path / "cloth.yaml"), "-o", str(tmp_path / "cloth.jpg")])
    assert result.exit_code != 0
