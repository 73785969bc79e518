"""Figures of meshes: one camera and one scale, or one shape of several scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from harness.base import rows as base_rows
from harness.report import opengl
from harness.report.figures.faults import faults
from tests import figure_results as made
from tests.drawn_figures import ALIKE, FOLDER, MESHES, composed_meshes, sheet, similarity

LOOKS = FOLDER / "meshes.png"


@pytest.mark.skipif(opengl.problem() is not None, reason=opengl.problem() or "")
def test_meshes_side_by_side_have_one_camera_one_scale_and_the_distance_from_the_lowest_residual(
    tmp_path: Path,
) -> None:
    folder = made.recorded(tmp_path)
    figure, pictures = composed_meshes("comparison", folder)
    assert faults(figure) == []
    assert len({picture.limit for picture in pictures}) == len({picture.aspect for picture in pictures}) == 1
    assert len({picture.render.view for picture in pictures}) == 1
    shown = [np.asarray(ax.images[0].get_array()) for ax in figure.axes[:2]]
    assert all((picture.min(axis=-1) < 200).mean() > 0.1 for picture in shown), "the mesh fills its place"
    alone, (one,) = composed_meshes("run", folder)
    assert len(one.rows()) == 36
    assert faults(alone) == []


@pytest.mark.skipif(opengl.problem() is not None, reason=opengl.problem() or "")
def test_a_sheet_has_each_scene_once_of_one_shape_and_by_one_scale(tmp_path: Path) -> None:
    folder = made.recorded(tmp_path)
    for path in [*(folder / "rows").glob("*.parquet")]:
        table = base_rows.read([path]).to_pylist()
        if table[0]["solver"] == "numba":
            made.write(path, [row | {"scene": "other-cloth"} for row in table])
    figure, pictures = composed_meshes("scenes", folder)
    assert faults(figure) == []
    assert [picture.title for picture in pictures] == ["cloth", "other cloth"]
    assert len({picture.limit for picture in pictures}) == len({picture.aspect for picture in pictures}) == 1
    assert "numba, 36 vertices" in pictures[1].facts


@pytest.mark.skipif(opengl.problem() is not None, reason=opengl.problem() or "")
def test_the_sheet_of_meshes_looks_as_it_did(tmp_path: Path) -> None:
    folder = made.recorded(tmp_path / "results")
    now = sheet([composed_meshes(kind, folder, 85.0)[0] for kind in MESHES], (1020, 360))
    now.save(tmp_path / "meshes.png")
    told = f"look at {tmp_path / 'meshes.png'} beside {LOOKS}, and where it is better, put it there"
    assert coarse(now, Image.open(LOOKS)) > ALIKE, told
    turned = Image.fromarray(np.asarray(now)[:, ::-1])
    assert coarse(now, turned) < 0.5


def coarse(one: Image.Image, other: Image.Image) -> float:
    """How alike they are in parts of 3 pixels: other drawing libraries round the edges of triangles otherwise."""
    return similarity(one.reduce(3), other.reduce(3))
