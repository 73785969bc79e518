"""Strain, colours and normals of a recorded mesh, against plain formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.record.shading import LEVELS, NEUTRAL, STRAIN_COLOURS, Shading, palette
from tests.recordings import MESHES, info


def rgba(packed: np.ndarray) -> np.ndarray:
    """0xRRGGBBAA as channels, shape (..., 4)."""
    return packed[..., None] >> np.array([24, 16, 8, 0]) & 255


@pytest.mark.parametrize("mesh", MESHES)
def test_strain_is_length_over_rest_length_minus_one(mesh: str):
    of = info(mesh)
    p = of.mesh.rest + 0.1 * np.random.default_rng(1).normal(size=of.mesh.rest.shape)
    i, j = of.springs.T
    expected = np.linalg.norm(p[i] - p[j], axis=1) / of.rest_lengths - 1
    of_spring, of_vertex = Shading(of).strains(p)
    np.testing.assert_allclose(of_spring, expected, atol=1e-14)  # round-off of a sum of three squares
    for v in range(len(p)):
        around = of_spring[(i == v) | (j == v)]
        assert of_vertex[v] == around[np.argmax(np.abs(around))]


def test_strain_is_zero_where_there_is_nothing_to_stretch():
    of = replace(info(), springs=np.array([[0, 1]]), rest_lengths=np.zeros(1))
    of_spring, of_vertex = Shading(of).strains(of.mesh.rest)
    assert not of_spring.any()
    assert not of_vertex.any()


def test_a_strain_that_is_no_number_reaches_its_vertices_and_is_neutral():
    of = info()
    p = of.mesh.rest.copy()
    p[3] = np.nan
    shading = Shading(of)
    _, of_vertex = shading.strains(p)
    touched = of.springs[(of.springs == 3).any(axis=1)]
    assert set(np.flatnonzero(np.isnan(of_vertex))) == set(touched.ravel())
    assert (rgba(shading.colours(of_vertex))[3] == NEUTRAL).all()


def test_colours_run_from_compressed_to_stretched_and_stay_at_the_ends():
    colours = rgba(Shading(info()).colours(np.array([-np.inf, -5.0, -0.1, 0.0, 0.1, 5.0, np.inf])))
    hexes = ["#" + "".join(f"{channel:02x}" for channel in colour[:3]) for colour in colours]
    low, _, middle, _, high = STRAIN_COLOURS
    assert hexes == [low, low, low, middle, high, high, high]
    assert (colours[:, 3] == 255).all()


def test_equal_steps_of_strain_are_equal_steps_of_colour():
    shading = Shading(info())
    strains = np.linspace(-0.1, 0.1, LEVELS)
    np.testing.assert_array_equal(rgba(shading.colours(strains)), palette()[:-1])


def test_normals_are_unit_vectors_to_their_rounding():
    rng = np.random.default_rng(2)
    of = info()
    p = (of.mesh.rest + 0.05 * rng.normal(size=of.mesh.rest.shape)).astype(np.float32)
    a, b, c = (p[of.mesh.triangles[:, k]].astype(float) for k in range(3))
    expected = np.zeros((len(p), 3))
    for k in range(3):
        np.add.at(expected, of.mesh.triangles[:, k], np.cross(b - a, c - a))
    expected /= np.linalg.norm(expected, axis=1)[:, None]
    # half a step of 1/32, and a little for the float32 sums
    np.testing.assert_allclose(Shading(of).normals(p), expected, atol=0.5 / 32 + 1e-4)


def test_there_is_no_normal_without_a_triangle_of_an_area():
    of = info()
    flat = np.zeros_like(of.mesh.rest, dtype=np.float32)
    assert not Shading(of).normals(flat).any()
    assert not Shading(info("chain")).normals(info("chain").mesh.rest.astype(np.float32)).any()
