"""Figures of meshes: one camera and one scale, or one shape of several scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from springbench.harness.report import opengl_probe
from springbench.harness.report.figures.figure_drawing import find_layout_faults
from springbench.harness.results import parquet_rows as base_rows

from tests import synthetic_results as made
from tests.figure_images import (
    EXPECTED_FOLDER,
    MESH_FIGURE_KINDS,
    MIN_SIMILARITY,
    compose_mesh_kind,
    least_similarity,
    tile_figures,
)

EXPECTED_SHEET = EXPECTED_FOLDER / "meshes.png"


@pytest.mark.skipif(opengl_probe.find_opengl_problem() is not None, reason=opengl_probe.find_opengl_problem() or "")
def test_meshes_side_by_side_have_one_camera_one_scale_and_the_distance_from_the_lowest_residual(
    tmp_path: Path,
) -> None:
    folder = made.write_recorded_runs(tmp_path)
    figure, pictures = compose_mesh_kind("comparison", folder)
    assert find_layout_faults(figure) == []
    assert len({picture.strain_limit for picture in pictures}) == len({picture.aspect for picture in pictures}) == 1
    assert len({picture.render.view for picture in pictures}) == 1
    shown = [np.asarray(ax.images[0].get_array()) for ax in figure.axes[:2]]
    assert all("no self-contact" in picture.facts for picture in pictures)
    assert all((picture.min(axis=-1) < 200).mean() > 0.1 for picture in shown), "the mesh fills its place"
    alone, (one,) = compose_mesh_kind("run", folder)
    assert len(one.csv_rows()) == 36
    assert find_layout_faults(alone) == []


@pytest.mark.skipif(opengl_probe.find_opengl_problem() is not None, reason=opengl_probe.find_opengl_problem() or "")
def test_a_sheet_has_each_scene_once_of_one_shape_and_by_one_scale(tmp_path: Path) -> None:
    folder = made.write_recorded_runs(tmp_path)
    for path in [*(folder / "rows").glob("*.parquet")]:
        table = base_rows.read_rows([path]).to_pylist()
        if table[0]["solver"] == "numba":
            made.write_result_rows(path, [row | {"scene": "other-cloth"} for row in table])
    figure, pictures = compose_mesh_kind("scenes", folder)
    assert find_layout_faults(figure) == []
    assert [picture.title for picture in pictures] == ["cloth", "other cloth"]
    assert len({picture.strain_limit for picture in pictures}) == len({picture.aspect for picture in pictures}) == 1
    assert "numba, 36 vertices" in pictures[1].facts


@pytest.mark.skipif(opengl_probe.find_opengl_problem() is not None, reason=opengl_probe.find_opengl_problem() or "")
def test_the_sheet_of_meshes_looks_as_it_did(tmp_path: Path) -> None:
    folder = made.write_recorded_runs(tmp_path / "results")
    now = tile_figures([compose_mesh_kind(kind, folder, 85.0)[0] for kind in MESH_FIGURE_KINDS], (1020, 360))
    now.save(tmp_path / "meshes.png")
    hint = f"compare {tmp_path / 'meshes.png'} with {EXPECTED_SHEET}; if it is better, replace the latter"
    assert coarse(now, Image.open(EXPECTED_SHEET)) > MIN_SIMILARITY, hint
    turned = Image.fromarray(np.asarray(now)[:, ::-1])
    assert coarse(now, turned) < 0.5


def coarse(one: Image.Image, other: Image.Image) -> float:
    """How alike they are in parts of 3 pixels: other drawing libraries round the edges of triangles otherwise."""
    return least_similarity(one.reduce(3), other.reduce(3))
