"""Whether nothing is near on a way, told by patches and by boxes, against brute force over fast motions."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from harness.scenes.mesh.base import Mesh
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.surfaces import Balloon
from solvers.contact import boxes, flat
from solvers.contact.barrier import distances
from solvers.contact.boxes import Tree
from solvers.contact.contacts import Pairs
from solvers.contact.patches import Patches
from solvers.contact.ways import LEFT, unevenness
from solvers.problem import Positions
from tests.self_contacts import sides

REACH = 0.06
"""Half of the spacing of the sheet below [m]."""


class Made:
    """A mesh, its patches, and all pairs of its primitives that share no vertex."""

    def __init__(self, mesh: Mesh) -> None:
        n, edges = len(mesh.rest), sides(mesh.triangles)
        self.rest, corners = mesh.rest, mesh.triangles
        self.trees = [Tree.of(self.rest, x) for x in (np.arange(n)[:, None], edges, corners)]
        self.patches = Patches.of(self.rest, self.trees[0], self.trees[1], self.trees[2], 4 * REACH)
        one = [(i, *t) for i in range(n) for t in corners.tolist() if i not in t]
        two = [(*e, *f) for e, f in combinations(edges.tolist(), 2) if not set(e) & set(f)]
        none = np.empty(0)
        self.pairs = Pairs(np.array(one + two), len(one), none, none, none, 0.0, 0.0)

    def met(self, p: Positions, q: Positions, share: float) -> np.ndarray:
        """Which pairs come nearer than the reach or the share of their distance at p, at one of some times."""
        first, least = distances(self.pairs, p), np.full(len(self.pairs.vertices), np.inf)
        for t in np.linspace(0.0, 1.0, 13):
            least = np.minimum(least, distances(self.pairs, p + t * (q - p)))
        return least < np.maximum(REACH, share * first)


@pytest.fixture(scope="module", params=["sheet", "balloon"])
def made(request) -> Made:
    return Made(Grid().build(9) if request.param == "sheet" else Balloon(radius=0.9).build(3))


def moved(rest: Positions, seed: int) -> Positions:
    """Turned, sheared, bent and folded, and a little rough: from all but nothing to beyond recognition."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    size = 10.0 ** rng.uniform(-2.5, 0.3)
    x = rest @ (np.eye(3) + 0.3 * min(size, 1.0) * rng.normal(size=(3, 3)))
    for _ in range(2):
        x = x + 0.3 * size * np.sin(rest @ rng.normal(size=3) * 3.0 + rng.uniform(0, 6))[:, None] * rng.normal(size=3)
    x = x + 0.02 * size * rng.normal(size=x.shape)
    return x @ turn + 10.0 * rng.normal(size=3)


@pytest.mark.parametrize("share", [0.0, LEFT])
def test_nothing_is_near_where_patches_say_so_however_fast_it_moves(made, share):
    said = 0
    for seed in range(24):
        p = moved(made.rest, seed)
        q = moved(made.rest, 100 + seed) if seed % 2 else p + 0.4 * (moved(p - p.mean(axis=0), 200 + seed) - p)
        clear = made.patches.clear(p, q, REACH, share)
        assert not (clear and made.met(p, q, share).any())
        said += clear
    assert 0 < said < 24


def test_patches_that_are_not_doubted_have_nothing_near_in_them(made):
    told, patches = 0, made.patches
    owner = {}
    for one in (patches.points, patches.edges, patches.triangles):
        of = np.repeat(np.arange(len(one.starts) - 1), np.diff(one.starts))
        owner |= {tuple(x): k for x, k in zip(one.corners.tolist(), of.tolist(), strict=True)}
    for seed in range(8):
        p = moved(made.rest, 300 + seed)
        q = p + 1e-3 * moved(p, 400 + seed)
        lies = [patches._lies(x) for x in (p, q)]
        doubted = np.empty_like(patches.known)
        apart = np.append(patches.apart, np.zeros(8))  # read by eights
        count = len(patches.known)
        count = flat.doubtful(patches.rest, lies[0].lie, lies[1].lie, patches.known, count, apart, REACH, LEFT, doubted)
        clear = {tuple(x) for x in patches.known.tolist()} - {tuple(x) for x in doubted[:count].tolist()}
        told += len(clear)
        for k in np.flatnonzero(made.met(p, q, LEFT)):
            x, cut = made.pairs.vertices[k].tolist(), 1 if k < made.pairs.points else 2
            assert tuple(sorted((owner[tuple(x[:cut])], owner[tuple(x[cut:])]))) not in clear
    assert told > 0 or made.rest[:, 1].any()  # a coarse balloon has no flat patch


def test_boxes_leave_out_no_pair_that_comes_near(made):
    points, edges, triangles = made.trees
    for seed in range(4):
        p, q = moved(made.rest, 500 + seed), moved(made.rest, 600 + seed)
        found, first = boxes.near(points, triangles, edges, p, q, REACH, LEFT)
        names = {(*points.corners[i], *triangles.corners[j]) for i, j in found[:first]}
        names |= {frozenset((tuple(edges.corners[i]), tuple(edges.corners[j]))) for i, j in found[first:]}
        wanted = made.pairs.vertices[made.met(p, q, LEFT)].tolist()
        many = int(made.met(p, q, LEFT)[: made.pairs.points].sum())
        assert {tuple(x) for x in wanted[:many]} <= names
        assert {frozenset((tuple(x[:2]), tuple(x[2:]))) for x in wanted[many:]} <= names


def test_a_sheet_that_swings_as_one_piece_is_clear_however_far():
    sheet = Made(Grid().build(9))
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    p = sheet.rest @ turn
    angle = 0.7
    about = np.array([[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]])
    assert sheet.patches.clear(p, p @ about + 50.0, REACH, LEFT)
    assert not sheet.patches.clear(p, 1e-3 * p, REACH, LEFT)


@pytest.mark.parametrize("n", [1, 7, 8, 30])
def test_unevenness_is_the_diagonal_of_the_box_of_all_ways(n):
    rng = np.random.default_rng(n)
    p, q = rng.normal(size=(2, n, 3))
    assert unevenness(p, q) == pytest.approx(float(np.linalg.norm(np.ptp(q - p, axis=0))), rel=1e-15)
    assert unevenness(p, p + 3.0) <= 1e-14
    for bad in (np.nan, np.inf):
        q[n - 1, 1] = bad
        assert unevenness(p, q) == np.inf


def test_patches_of_a_stack_tell_nothing():
    sheet = Grid().build(5)
    layers = [sheet.rest + 0.5 * REACH * k * np.eye(3)[1] for k in range(30)]
    rest, each = np.concatenate(layers), len(sheet.rest)
    triangles = np.concatenate([sheet.triangles + each * k for k in range(30)])
    trees = [Tree.of(rest, x) for x in (np.arange(len(rest))[:, None], sides(triangles), triangles)]
    patches = Patches.of(rest, trees[0], trees[1], trees[2], 20 * REACH)
    assert patches.crowded
    assert not patches.clear(rest, rest + 5.0, REACH, LEFT)
