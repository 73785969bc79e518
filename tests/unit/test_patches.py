"""Whether nothing is near on a path, by patches and by boxes, against brute force over fast motions."""

from __future__ import annotations

from functools import cached_property
from itertools import combinations

import numpy as np
import pytest
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.solvers.contact.broad_phase import cluster_bounds
from springbench.solvers.contact.broad_phase.bvh import BVH, find_candidate_pairs
from springbench.solvers.contact.broad_phase.cluster_culling import ClusterCulling
from springbench.solvers.contact.ccd import MIN_GAP_FRACTION, max_relative_displacement
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.collisions import Candidates, pad_positions
from springbench.solvers.contact.contact_potential import SelfContact
from springbench.solvers.contact.geometry.aabb import CollisionQuery
from springbench.solvers.contact.potentials.barrier import compute_distances
from springbench.solvers.model.step_problem import Positions

from tests.self_contact_scenes import unique_edges

INFLATION_RADIUS = 0.06
"""Half of the spacing of the sheet below [m]."""


class ClusteredMesh:
    """A mesh, its patches, and all pairs of its primitives that share no vertex."""

    def __init__(self, mesh: Mesh) -> None:
        n, edges = len(mesh.rest_positions), unique_edges(mesh.triangles)
        self.rest_positions, corners = mesh.rest_positions, mesh.triangles
        self.trees = [BVH.from_primitives(self.rest_positions, x) for x in (np.arange(n)[:, None], edges, corners)]
        self.patches = ClusterCulling.from_rest_shape(
            self.rest_positions, self.trees[0], self.trees[1], self.trees[2], 4 * INFLATION_RADIUS
        )
        one = [(i, *t) for i in range(n) for t in corners.tolist() if i not in t]
        two = [(*e, *f) for e, f in combinations(edges.tolist(), 2) if not set(e) & set(f)]
        none = np.empty(0)
        self.pairs = Candidates(np.array(one + two), len(one), none, none, none, 0.0, 0.0)

    def find_close_pairs(self, p: Positions, q: Positions, limits: CollisionQuery) -> np.ndarray:
        """Which pairs come to their limits at one of some times."""
        first, least = compute_distances(self.pairs, p), np.full(len(self.pairs.vertices), np.inf)
        for t in np.linspace(0.0, 1.0, 13):
            least = np.minimum(least, compute_distances(self.pairs, p + t * (q - p)))
        return least < np.maximum(limits.inflation_radius, limits.min_distance + limits.relative_min_distance * first)

    def owners(self) -> dict[tuple[int, ...], int]:
        """The patch of each primitive, by its vertices."""
        found = {}
        for one in (self.patches.points, self.patches.edges, self.patches.triangles):
            of = np.repeat(np.arange(len(one.cluster_starts) - 1), np.diff(one.cluster_starts))
            found |= {tuple(x): k for x, k in zip(one.primitives.tolist(), of.tolist(), strict=True)}
        return found

    @cached_property
    def near_at_rest(self) -> np.ndarray:
        """Which pairs are of patches that are known."""
        owner, known = (
            self.owners(),
            {tuple(x) for x in self.patches.cluster_pairs.clusters[: self.patches.num_rest_pairs].tolist()},
        )
        cut = np.where(np.arange(len(self.pairs.vertices)) < self.pairs.num_point_triangle, 1, 2).tolist()
        both = [
            (owner[tuple(x[:c])], owner[tuple(x[c:])]) for x, c in zip(self.pairs.vertices.tolist(), cut, strict=True)
        ]
        return np.array([(min(x), max(x)) in known for x in both])


@pytest.fixture(scope="module", params=["sheet", "balloon"])
def clustered_mesh(request) -> ClusteredMesh:
    return ClusteredMesh(
        GridMesh().build_mesh(9) if request.param == "sheet" else BalloonMesh(radius=0.9).build_mesh(3)
    )


def deform_positions(rest: Positions, seed: int) -> Positions:
    """Turned, sheared, bent and folded, and a little rough: from all but nothing to beyond recognition."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    size = 10.0 ** rng.uniform(-2.5, 0.3)
    x = rest @ (np.eye(3) + 0.3 * min(size, 1.0) * rng.normal(size=(3, 3)))
    for _ in range(2):
        x = x + 0.3 * size * np.sin(rest @ rng.normal(size=3) * 3.0 + rng.uniform(0, 6))[:, None] * rng.normal(size=3)
    x = x + 0.02 * size * rng.normal(size=x.shape)
    return x @ turn + 10.0 * rng.normal(size=3)


@pytest.mark.parametrize("share", [0.0, MIN_GAP_FRACTION])
def test_clearance_bounds_are_valid_at_any_speed(clustered_mesh, share):
    said, limits, near = 0, CollisionQuery(INFLATION_RADIUS, 0.3 * INFLATION_RADIUS, share), clustered_mesh.near_at_rest
    for seed in range(24):
        p = deform_positions(clustered_mesh.rest_positions, seed)
        q = (
            deform_positions(clustered_mesh.rest_positions, 100 + seed)
            if seed % 2
            else p + 0.4 * (deform_positions(p - p.mean(axis=0), 200 + seed) - p)
        )
        gaps = clustered_mesh.patches.compute_clearance_bounds(p, q, limits)
        if gaps:
            assert not clustered_mesh.find_close_pairs(p, q, limits).any()
            apart = compute_distances(clustered_mesh.pairs, q)
            assert INFLATION_RADIUS <= gaps.near_clearance <= apart[near].min()
            assert gaps.far_clearance <= apart[~near].min(initial=np.inf)
            said += 1
    assert 0 < said < 24


def test_stored_bounds_of_earlier_displacements_are_valid(clustered_mesh):
    # From each way's end, or from its begin, go on by steps long and short; far things were looked at long before.
    said, skipped, limits, near = (
        0,
        0,
        CollisionQuery(INFLATION_RADIUS, 0.3 * INFLATION_RADIUS, MIN_GAP_FRACTION),
        clustered_mesh.near_at_rest,
    )
    for seed in range(2):
        rng = np.random.default_rng(seed)
        p = clustered_mesh.rest_positions @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        clustered_mesh.patches.recent_poses.clear()
        for _ in range(8):
            size = 10.0 ** rng.uniform(-2.5, 0.0)
            q = p + size * np.sin(clustered_mesh.rest_positions @ rng.normal(size=3) * 2.0)[:, None] * rng.normal(
                size=3
            )
            looked = list(clustered_mesh.patches.remote_clearances)
            gaps = clustered_mesh.patches.compute_clearance_bounds(p, q, limits)
            if gaps:
                assert not clustered_mesh.find_close_pairs(p, q, limits).any()
                apart = compute_distances(clustered_mesh.pairs, q)
                assert gaps.near_clearance <= apart[near].min()
                assert gaps.far_clearance <= apart[~near].min(initial=np.inf)
                said += 1
                skipped += any(one is other for one in looked for other in clustered_mesh.patches.remote_clearances)
                p = q if rng.uniform() < 0.7 else p
    assert said > 0
    assert skipped > 0 or clustered_mesh.rest_positions[:, 1].any()  # a balloon of few patches has nothing that is far


def test_a_displacement_from_the_same_start_reuses_its_query(clustered_mesh):
    limits, patches = CollisionQuery(INFLATION_RADIUS, 0.0, MIN_GAP_FRACTION), clustered_mesh.patches
    p = 2.0 * clustered_mesh.rest_positions
    q, r = 1.02 * p, 1.04 * p @ np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    patches.recent_poses.clear()
    patches.remote_clearances.clear()
    expected = patches.compute_clearance_bounds(p, r, limits)
    patches.recent_poses.clear()
    patches.remote_clearances.clear()
    patches.compute_clearance_bounds(p, q, limits)
    begin, end = patches._fit_clusters(p, limits), patches._fit_clusters(r, limits)
    np.testing.assert_array_equal(begin.positions[:, :3], p)
    np.testing.assert_array_equal(end.positions[:, :3], r)
    found = patches.compute_clearance_bounds(p, r, limits)
    assert (found is None) == (expected is None)
    assert found is None or expected is None or found.near_clearance == expected.near_clearance


def test_resolved_patches_contain_no_near_pairs(clustered_mesh):
    num_clear, patches, owner, limits = (
        0,
        clustered_mesh.patches,
        clustered_mesh.owners(),
        CollisionQuery(INFLATION_RADIUS, 0.3 * INFLATION_RADIUS, MIN_GAP_FRACTION),
    )
    for seed in range(8):
        p = deform_positions(clustered_mesh.rest_positions, 300 + seed)
        q = p + 1e-3 * deform_positions(p, 400 + seed)
        lies = [patches._fit_clusters(x, limits).pose for x in (p, q)]
        memory = patches.scratch
        doubted = np.empty((patches.num_rest_pairs, 2), np.int64)
        count, near = cluster_bounds.unresolved_cluster_pairs(
            *lies,
            patches.cluster_pairs,
            patches.num_rest_pairs,
            limits,
            INFLATION_RADIUS,
            memory.projection,
            memory.tile,
            doubted,
        )
        known = {tuple(x) for x in patches.cluster_pairs.clusters[: patches.num_rest_pairs].tolist()}
        clear, apart = known - {tuple(x) for x in doubted[:count].tolist()}, compute_distances(clustered_mesh.pairs, q)
        num_clear += len(clear)
        bad = clustered_mesh.find_close_pairs(p, q, limits) | (apart < near)
        for k in np.flatnonzero(bad):
            x, cut = clustered_mesh.pairs.vertices[k].tolist(), 1 if k < clustered_mesh.pairs.num_point_triangle else 2
            assert tuple(sorted((owner[tuple(x[:cut])], owner[tuple(x[cut:])]))) not in clear
    assert num_clear > 0 or clustered_mesh.rest_positions[:, 1].any()  # a coarse balloon has no flat patch


def test_what_is_near_at_rest_moves_relative_to_itself_by_at_most_the_max_relative_displacement(clustered_mesh):
    near = clustered_mesh.pairs.vertices[clustered_mesh.near_at_rest]
    for seed in range(3):
        p, q = (
            deform_positions(clustered_mesh.rest_positions, seed),
            deform_positions(clustered_mesh.rest_positions, 50 + seed),
        )
        displacement = q - p
        other = np.linalg.norm(displacement[near[:, :, None]] - displacement[near[:, None, :]], axis=-1).max()
        found = clustered_mesh.patches.max_relative_displacement(p, q)
        assert other <= found <= max_relative_displacement(p, q) * (1.0 + 1e-12)
        assert clustered_mesh.patches.max_relative_displacement(p, p + 3.0) <= 1e-14


def build_displacements(p: Positions) -> list[Positions]:
    """By less than primitives are long, and by more: two halves past each other, and all as it likes; the second ones
    while all moves alike."""
    rng = np.random.default_rng(0)
    half = np.where((p - p.mean(axis=0)) @ rng.normal(size=3) > 0.0, 1.0, -1.0)[:, None] * rng.normal(size=3)
    return [0.02 * half, half + 3.0, 0.01 * rng.normal(size=p.shape), deform_positions(p, 1) - p + 3.0]


@pytest.mark.parametrize("share", [MIN_GAP_FRACTION, 0.9])
def test_boxes_leave_out_no_pair_that_comes_to_its_limits(clustered_mesh, share):
    points, edges, triangles = clustered_mesh.trees
    p, bound = 0.3 * deform_positions(clustered_mesh.rest_positions, 504), 0
    for displacement in build_displacements(p):
        limits = CollisionQuery(
            0.5 * INFLATION_RADIUS, 0.2 * INFLATION_RADIUS, share, max_relative_displacement(p, p + displacement)
        )
        x, y = pad_positions(p), pad_positions(p + displacement)
        one, two = (
            find_candidate_pairs(points, triangles, x, y, limits),
            find_candidate_pairs(edges, edges, x, y, limits),
        )
        names = {(*points.primitives[i], *triangles.primitives[j]) for i, j in one}
        names |= {frozenset((tuple(edges.primitives[i]), tuple(edges.primitives[j]))) for i, j in two}
        met = clustered_mesh.find_close_pairs(p, p + displacement, limits)
        expected, many = (
            clustered_mesh.pairs.vertices[met].tolist(),
            int(met[: clustered_mesh.pairs.num_point_triangle].sum()),
        )
        assert {tuple(x) for x in expected[:many]} <= names
        assert {frozenset((tuple(x[:2]), tuple(x[2:]))) for x in expected[many:]} <= names
        bound += len(expected)
    assert bound > 0


def test_a_sheet_that_swings_as_one_piece_is_clear_however_far():
    sheet = ClusteredMesh(GridMesh().build_mesh(9))
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    p = sheet.rest_positions @ turn
    angle = 0.7
    about = np.array([[1, 0, 0], [0, np.cos(angle), np.sin(angle)], [0, -np.sin(angle), np.cos(angle)]])
    limits = CollisionQuery(INFLATION_RADIUS, 0.0, MIN_GAP_FRACTION)
    assert sheet.patches.compute_clearance_bounds(p, p @ about + 50.0, limits)
    assert not sheet.patches.compute_clearance_bounds(p, 1e-3 * p, limits)


@pytest.mark.parametrize("n", [1, 7, 8, 30])
def test_relative_displacement_is_the_diagonal_of_the_box_of_all_displacements(n):
    rng = np.random.default_rng(n)
    p, q = rng.normal(size=(2, n, 3))
    assert max_relative_displacement(p, q) == pytest.approx(float(np.linalg.norm(np.ptp(q - p, axis=0))), rel=1e-15)
    assert max_relative_displacement(p, p + 3.0) <= 1e-14
    for bad in (np.nan, np.inf):
        q[n - 1, 1] = bad
        assert max_relative_displacement(p, q) == np.inf


def test_patches_of_a_stack_give_no_bounds():
    sheet = GridMesh().build_mesh(5)
    layers = [sheet.rest_positions + 0.5 * INFLATION_RADIUS * k * np.eye(3)[1] for k in range(30)]
    rest, each = np.concatenate(layers), len(sheet.rest_positions)
    triangles = np.concatenate([sheet.triangles + each * k for k in range(30)])
    trees = [BVH.from_primitives(rest, x) for x in (np.arange(len(rest))[:, None], unique_edges(triangles), triangles)]
    patches = ClusterCulling.from_rest_shape(rest, trees[0], trees[1], trees[2], 20 * INFLATION_RADIUS)
    assert patches.is_dense
    assert not patches.compute_clearance_bounds(
        rest, rest + 5.0, CollisionQuery(INFLATION_RADIUS, 0.0, MIN_GAP_FRACTION)
    )


def test_idle_contact_allows_only_free_displacements_and_mostly_without_a_query(monkeypatch):
    mesh, arguments, num_displacements = GridMesh().build_mesh(17), [], 0
    surface = CollisionMesh.from_rest_shape(
        mesh.rest_positions,
        unique_edges(mesh.triangles),
        mesh.triangles,
        np.ones(len(mesh.rest_positions)),
        0.006,
        0.006,
    )
    contact, clear = SelfContact(surface), ClusterCulling.compute_clearance_bounds
    monkeypatch.setattr(
        ClusterCulling, "compute_clearance_bounds", lambda *given: arguments.append(given) or clear(*given)
    )
    rng = np.random.default_rng(0)
    p = mesh.rest_positions @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for k in range(14):
        size = 0.2 if k % 8 == 0 else 0.004
        displacement = size * np.sin(mesh.rest_positions @ rng.normal(size=3) * 2.0)[:, None] * rng.normal(
            size=3
        ) + rng.normal(size=3)
        if contact.collision_free_step_size(p, displacement) == 1.0:
            before = surface.find_proximity_candidates(p, 0.1)
            for t in np.linspace(0.0, 1.0, 5):
                gap = compute_distances(before, p + t * displacement) - 0.006
                assert (gap >= 0.5 * MIN_GAP_FRACTION * (compute_distances(before, p) - 0.006)).all()
            p, num_displacements = p + displacement, num_displacements + 1
            assert (contact.value(p) == 0.0) == (len(surface.find_proximity_candidates(p, 0.012).vertices) == 0)
    assert num_displacements > 10
    assert len(arguments) < num_displacements
