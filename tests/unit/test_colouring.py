"""Colours of springs and of vertices."""

from __future__ import annotations

import numpy as np
import pytest
from springbench.solvers.methods.vertex_block import colouring

from tests.network_matrices import grid_springs
from tests.scene_builders import SCENE_BUILDERS, build_random_network


def star(n: int) -> np.ndarray:
    return np.array([[0, i] for i in range(1, n)])


NETWORKS = {
    "nothing": (np.empty((0, 2), np.int64), 0),
    "vertices alone": (np.empty((0, 2), np.int64), 5),
    "chain": (np.array([[i, i + 1] for i in range(9)]), 10),
    "ring of odd length": (np.array([[i, (i + 1) % 7] for i in range(7)]), 7),
    "star": (star(500), 500),
    "twins and loops": (np.array([[0, 1], [1, 0], [2, 2], [1, 2], [0, 1]]), 4),
    "grid with diagonals": (grid_springs(9, 7), 63),
    "solid": (grid_springs(5, 4, 3), 60),
    "random": (build_random_network(np.random.default_rng(0), 40, 200)[1].edges, 40),
    "cloth with shear and bending": (SCENE_BUILDERS["cloth"](1e10).all_springs.edges, 64),
}
networks = pytest.mark.parametrize(("edges", "n"), NETWORKS.values(), ids=list(NETWORKS))


def parts(coloured: colouring.Colouring) -> list[np.ndarray]:
    return [
        coloured.item_order[a:b] for a, b in zip(coloured.colour_starts[:-1], coloured.colour_starts[1:], strict=True)
    ]


@networks
def test_no_two_springs_of_a_colour_share_a_vertex(edges, n):
    for part in parts(colouring.colour_springs(edges, n)):
        ends = edges[part]
        ends = ends[ends[:, 0] != ends[:, 1]]  # a loop moves nothing
        assert len(np.unique(ends)) == ends.size


@networks
def test_no_two_vertices_of_a_colour_share_a_spring(edges, n):
    for part in parts(colouring.colour_vertices(edges, n)):
        both = np.isin(edges, part).all(axis=1)
        assert (edges[both, 0] == edges[both, 1]).all()


@networks
def test_every_one_has_one_colour_and_no_colour_is_empty(edges, n):
    for coloured, count in ((colouring.colour_springs(edges, n), len(edges)), (colouring.colour_vertices(edges, n), n)):
        assert sorted(coloured.item_order) == list(range(count))
        assert all(len(part) and (np.diff(part) > 0).all() for part in parts(coloured))


@networks
def test_there_are_no_more_colours_than_greedy_may_need(edges, n):
    proper = edges[edges[:, 0] != edges[:, 1]]
    degree = np.bincount(proper.ravel(), minlength=n).max(initial=0)
    neighbours = np.unique(np.concatenate([proper, proper[:, ::-1]]), axis=0)
    most = np.bincount(neighbours[:, 0], minlength=n).max(initial=0)
    assert colouring.colour_springs(edges, n).num_colours <= max(1, 2 * degree - 1)
    assert colouring.colour_vertices(edges, n).num_colours <= most + 1


@pytest.mark.parametrize(("name", "springs", "vertices"), [("chain", 2, 2), ("star", 499, 2)])
def test_what_has_few_colours_gets_no_more(name, springs, vertices):
    edges, n = NETWORKS[name]
    assert colouring.colour_springs(edges, n).num_colours == springs
    assert colouring.colour_vertices(edges, n).num_colours == vertices


def test_equal_networks_get_equal_colours():
    edges, n = NETWORKS["random"]
    for colours in (colouring.colour_springs, colouring.colour_vertices):
        one, two = colours(edges, n), colours(edges.copy(), n)
        np.testing.assert_array_equal(one.item_order, two.item_order)
        np.testing.assert_array_equal(one.colour_starts, two.colour_starts)
