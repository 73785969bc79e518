"""Strain, colours and normals of a recorded mesh, against plain formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from springbench.harness.recording.strain_scale import NEUTRAL_COLOUR, NUM_LEVELS, STRAIN_COLOURS, build_palette
from springbench.harness.recording.strain_shading import StrainShading

from tests.synthetic_recordings import MESHES_BY_KIND, build_recording_info


def rgba(packed: np.ndarray) -> np.ndarray:
    """0xRRGGBBAA as channels, shape (..., 4)."""
    return packed[..., None] >> np.array([24, 16, 8, 0]) & 255


@pytest.mark.parametrize("mesh", MESHES_BY_KIND)
def test_strain_is_length_over_rest_length_minus_one(mesh: str):
    of = build_recording_info(mesh)
    p = of.mesh.rest_positions + 0.1 * np.random.default_rng(1).normal(size=of.mesh.rest_positions.shape)
    i, j = of.springs.T
    expected = np.linalg.norm(p[i] - p[j], axis=1) / of.rest_lengths - 1
    of_spring, of_vertex = StrainShading(of).compute_strains(p)
    np.testing.assert_allclose(of_spring, expected, atol=1e-14)  # round-off of a sum of three squares
    for v in range(len(p)):
        around = of_spring[(i == v) | (j == v)]
        assert of_vertex[v] == around[np.argmax(np.abs(around))]


def test_strain_is_zero_where_there_is_nothing_to_stretch():
    of = replace(build_recording_info(), springs=np.array([[0, 1]]), rest_lengths=np.zeros(1))
    of_spring, of_vertex = StrainShading(of).compute_strains(of.mesh.rest_positions)
    assert not of_spring.any()
    assert not of_vertex.any()


def test_a_strain_that_is_no_number_reaches_its_vertices_and_is_neutral():
    of = build_recording_info()
    p = of.mesh.rest_positions.copy()
    p[3] = np.nan
    shading = StrainShading(of)
    _, of_vertex = shading.compute_strains(p)
    touched = of.springs[(of.springs == 3).any(axis=1)]
    assert set(np.flatnonzero(np.isnan(of_vertex))) == set(touched.ravel())
    assert (rgba(shading.compute_colours(of_vertex))[3] == NEUTRAL_COLOUR).all()


def test_colours_run_from_compressed_to_stretched_and_stay_at_the_ends():
    colours = rgba(
        StrainShading(build_recording_info()).compute_colours(np.array([-np.inf, -5.0, -0.1, 0.0, 0.1, 5.0, np.inf]))
    )
    hexes = ["#" + "".join(f"{channel:02x}" for channel in colour[:3]) for colour in colours]
    low, _, middle, _, high = STRAIN_COLOURS
    assert hexes == [low, low, low, middle, high, high, high]
    assert (colours[:, 3] == 255).all()


def test_equal_steps_of_strain_are_equal_steps_of_colour():
    shading = StrainShading(build_recording_info())
    strains = np.linspace(-0.1, 0.1, NUM_LEVELS)
    np.testing.assert_array_equal(rgba(shading.compute_colours(strains)), build_palette()[:-1])


def test_normals_are_unit_vectors_to_their_rounding():
    rng = np.random.default_rng(2)
    of = build_recording_info()
    p = (of.mesh.rest_positions + 0.05 * rng.normal(size=of.mesh.rest_positions.shape)).astype(np.float32)
    a, b, c = (p[of.mesh.triangles[:, k]].astype(float) for k in range(3))
    expected = np.zeros((len(p), 3))
    for k in range(3):
        np.add.at(expected, of.mesh.triangles[:, k], np.cross(b - a, c - a))
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    # half a step of 1/32, and a little for the float32 sums
    np.testing.assert_allclose(StrainShading(of).compute_normals(p), expected, atol=0.5 / 32 + 1e-4)


def test_there_is_no_normal_without_a_triangle_of_an_area():
    of = build_recording_info()
    flat = np.zeros_like(of.mesh.rest_positions, dtype=np.float32)
    assert not StrainShading(of).compute_normals(flat).any()
    assert (
        not StrainShading(build_recording_info("chain"))
        .compute_normals(build_recording_info("chain").mesh.rest_positions.astype(np.float32))
        .any()
    )
