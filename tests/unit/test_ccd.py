"""The bound of continuous collision detection in exact arithmetic: a bound that is a fifth too small lets pairs pass.

Coordinates are dyadic, so that positions, directions and steps are exact as fractions. The pairs of the table close at
their bound: no smaller one is safe for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import permutations
from typing import NamedTuple

import numpy as np
import pytest
from springbench.solvers.contact import ccd
from springbench.solvers.contact.broad_phase.candidate_cache import CACHE_INFLATION
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.collisions import Candidates, pad_positions
from springbench.solvers.contact.contact_potential import SelfContact
from springbench.solvers.contact.potentials.barrier import compute_distances

THICKNESS = 1 / 64
REMAINING_FRACTION = Fraction(1, 20)
"""Of a gap: what a step leaves at least (`springbench.solvers.contact.ccd`)."""

TRIANGLE = ((0, 0, 0), (8, 0, 0), (0, 8, 0))
FIRST_EDGE = ((-4, 0, 0), (4, 0, 0))
EDGE_ABOVE = ((0, -4, 1), (0, 4, 1))


class Closing(NamedTuple):
    """Four positions and displacements of a pair that is one unit apart along z and closes by a unit in a unit step, by
    as much as the largest displacements of both primitives, less the mean of all four, add up to."""

    positions: Sequence[tuple[float, ...]]
    displacements: Sequence[tuple[float, ...]]
    edges: bool


def _up(*z: float) -> list[tuple[float, ...]]:
    return [(0.0, 0.0, each) for each in z]


CLOSING = {
    "a point and a triangle that wait for each other": Closing([(1, 1, 1), *TRIANGLE], _up(-1, 0, 0, 0), False),
    "a point that waits": Closing([(1, 1, 1), *TRIANGLE], _up(0, 1, 1, 1), False),
    "both by half": Closing([(1, 1, 1), *TRIANGLE], _up(-0.75, 0.25, 0.25, 0.25), False),
    "a corner that rises": Closing([(0, 0, 1), *TRIANGLE], _up(0, 1, 0, 0), False),
    "a corner that rises to a point that falls": Closing([(0, 0, 1), *TRIANGLE], _up(-0.5, 0.5, 0, 0), False),
    "edges": Closing([*FIRST_EDGE, *EDGE_ABOVE], _up(0, 0, -1, -1), True),
    "edges, both by half": Closing([*FIRST_EDGE, *EDGE_ABOVE], _up(0.5, 0.5, -0.5, -0.5), True),
    "ends of edges": Closing([(0, 0, 0), (8, 0, 0), (0, 0, 1), (0, 8, 1)], _up(0.5, -0.5, -0.5, 0.5), True),
    "one end of an edge": Closing([(0, 0, 0), (8, 0, 0), (0, 0, 1), (0, 8, 1)], _up(1, 0, 0, 0), True),
}

FASTER = (0.5, 0.86, 0.95, 1.05, 1.12, 1.3, 4.0, 1000.0)
"""Units that a pair would close by in a whole step. Without a look pairs are free up to 0.9 of their gap."""


def pairs_of(edges: bool) -> Candidates:
    one = np.ones(1)
    return Candidates(np.arange(4)[None], 0 if edges else 1, one, one, 0 * one, THICKNESS, 0.5)


@pytest.mark.parametrize("name", CLOSING)
def test_no_pair_that_closes_at_its_bound_loses_more_than_nineteen_twentieths_of_its_gap(name):
    closing, gap = CLOSING[name], 1 - Fraction(THICKNESS)
    mean = sum(Fraction(d[2]) for d in closing.displacements) / 4
    moved, first = [abs(Fraction(d[2]) - mean) for d in closing.displacements], 2 if closing.edges else 1
    assert max(moved[:first]) + max(moved[first:]) == 1
    for axes in permutations(range(3)):
        for speed in FASTER:
            p = np.array(closing.positions, float)[:, axes]
            d = speed * np.array(closing.displacements, float)[:, axes]
            d += [4.0, -2.0, 0.5]  # a common motion bounds nothing
            step = Fraction(
                ccd.collision_free_step_size(
                    pairs_of(closing.edges), pad_positions(p), pad_positions(d), 1.0, *ccd.allocate_ccd_scratch()
                )
            )
            assert step * Fraction(speed) <= (1 - REMAINING_FRACTION) * gap  # exact: linear in the step
            # And it is of use: of a step that has to end, it ends in the last tenth of the gap.
            assert step == 1 or step * Fraction(speed) >= Fraction(89, 100) * gap


Exact = tuple[Fraction, ...]


def _minus(a: Exact, b: Exact) -> Exact:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def _dot(a: Exact, b: Exact) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def _to_edge(p: Exact, a: Exact, b: Exact) -> Fraction:
    """The squared distance of a point and an edge."""
    u, w = _minus(b, a), _minus(p, a)
    t = min(max(_dot(u, w) / _dot(u, u), Fraction(0)), Fraction(1))
    z = tuple(x - t * y for x, y in zip(w, u, strict=True))
    return _dot(z, z)


def squared_distance(x: Sequence[Exact], edges: bool) -> Fraction:
    """The squared distance of a point and a triangle, or of two edges: the least of the border's and the inside's."""
    a, b, c, d = x
    if edges:
        found = [_to_edge(a, c, d), _to_edge(b, c, d), _to_edge(c, a, b), _to_edge(d, a, b)]
        u, v, w = _minus(b, a), _minus(c, d), _minus(a, c)
    else:
        found = [_to_edge(a, b, c), _to_edge(a, b, d), _to_edge(a, c, d)]
        u, v, w = _minus(b, c), _minus(b, d), _minus(a, b)  # w + s u + t v, with s and t of b -> c and b -> d
    uu, uv, vv, uw, vw = _dot(u, u), _dot(u, v), _dot(v, v), _dot(u, w), _dot(v, w)
    det = uu * vv - uv * uv
    if det:
        s, t = (uv * vw - vv * uw) / det, (uv * uw - uu * vw) / det
        if s > 0 and t > 0 and (s < 1 and t < 1 if edges else s + t < 1):
            z = tuple(i + s * j + t * k for i, j, k in zip(w, u, v, strict=True))
            found.append(_dot(z, z))
    return min(found)


@pytest.mark.parametrize("edges", [False, True], ids=["point-triangle", "edge-edge"])
def test_no_random_pair_comes_nearer_than_allowed_on_its_path(edges):
    rng, ended = np.random.default_rng(0), 0
    for _ in range(24):
        p, d = (np.round(64 * rng.normal(size=(4, 3))) / 64 for _ in range(2))
        d[0] += 8.0 * (p[2] - p[0])
        gap = compute_distances(pairs_of(edges), p)[0] - THICKNESS
        if gap <= 0.0:
            continue
        step = Fraction(
            ccd.collision_free_step_size(
                pairs_of(edges), pad_positions(p), pad_positions(d), 1.0, *ccd.allocate_ccd_scratch()
            )
        )
        ended += step < 1
        least = (Fraction(THICKNESS) + Fraction(gap) * Fraction(49, 1000)) ** 2  # round-off of the gap aside
        for k in range(1, 9):
            t = step * k / 8
            at = [
                tuple(Fraction(a) + t * Fraction(b) for a, b in zip(x, y, strict=True))
                for x, y in zip(p, d, strict=True)
            ]
            assert squared_distance(at, edges) >= least
    assert ended >= 4


def test_candidates_stored_between_steps_bound_them_as_well():
    """Two triangles, one above the other, which close at the bound of twice the largest displacement; the second look
    uses the cache of the first."""
    rest = np.array([*TRIANGLE, *TRIANGLE], float)
    rest[3:, 2] = 1.0
    triangles, edges = np.array([[0, 1, 2], [3, 4, 5]]), np.array([[0, 1], [0, 2], [1, 2], [3, 4], [3, 5], [4, 5]])
    gap = 1 - Fraction(THICKNESS)
    for speed in FASTER:
        d = np.zeros_like(rest)
        d[:3, 2], d[3:, 2] = 0.5 * speed, -0.5 * speed
        contact = SelfContact(CollisionMesh.from_rest_shape(rest, edges, triangles, np.ones(6), THICKNESS, 1 / 16))
        for saved in (0.0, 0.125 / speed):  # the result of the last query is cached for the next one
            contact.value(rest)
            contact.collision_free_step_size(rest, saved * d)
            step = Fraction(contact.collision_free_step_size(rest, d))
            assert step * Fraction(speed) <= (1 - REMAINING_FRACTION) * gap


@pytest.mark.parametrize("way", [0.5, 1.9])
def test_stored_candidates_bound_no_step_beyond_their_range(way):
    """Of three triangles above each other, two in range, the third is no candidate and comes down on them."""
    layer, reach = np.array(TRIANGLE, float), 1 / 16
    limit = THICKNESS + reach

    def at(*heights: float) -> np.ndarray:
        return np.concatenate([layer + np.array([0.0, 0.0, z]) for z in heights])

    triangles = np.arange(9).reshape(3, 3)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [0, 2]]])
    contact = SelfContact(CollisionMesh.from_rest_shape(at(0, 1, 2), edges, triangles, np.ones(9), THICKNESS, reach))
    apart = 1.02 * CACHE_INFLATION * limit
    p = at(0.0, 0.5 * limit, 0.5 * limit + apart)
    d = at(0.0, 0.0, -way * limit) - at(0.0, 0.0, 0.0)
    contact.value(p)
    assert contact.candidate_caches[0].candidates.vertices.max() < 6
    step = contact.collision_free_step_size(p, d)
    assert step == 1.0 if way < 1.0 else step * way * limit <= 0.95 * (apart - THICKNESS)
