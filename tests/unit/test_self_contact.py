"""The barrier's parts against brute force and differences: distances, candidates, derivatives, safe steps."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from springbench.harness.scenes import edge_triangle_intersections
from springbench.harness.scenes.edge_triangle_intersections import find_edge_triangle_intersections
from springbench.solvers.contact.broad_phase.candidate_cache import CACHE_INFLATION
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.collisions import Candidates, allocate_collisions, build_collisions, pad_positions
from springbench.solvers.contact.contact_potential import SelfContact
from springbench.solvers.contact.potentials.barrier import compute_distances, compute_normal_forces, energy_and_gradient
from springbench.solvers.contact.potentials.hessian_blocks import ReusableBuffer
from springbench.solvers.model.step_problem import StepProblem, StepStart, System
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.hessian_pattern import BlockMatrix
from springbench.solvers.objective.step_objective import StepObjective

from tests.self_contact_scenes import (
    CONTACT_DHAT,
    CONTACT_THICKNESS,
    build_touching_sheets,
    exhaustive_step_size,
    random_displacement,
    unique_edges,
)


def pair(edges: bool) -> Candidates:
    one = np.ones(1)
    return Candidates(np.arange(4)[None], 0 if edges else 1, one, one, 0 * one, CONTACT_THICKNESS, CONTACT_DHAT)


def compute_gradient(pairs: Candidates, p: np.ndarray) -> np.ndarray:
    """The gradient."""
    out = np.zeros_like(p)
    energy_and_gradient(
        build_collisions(
            pairs, pad_positions(p), allocate_collisions(len(pairs.vertices), CONTACT_THICKNESS, CONTACT_DHAT)
        ),
        p,
        out,
    )
    return out


def sample_distance(p: np.ndarray, edges: bool) -> float:
    """The least distance among a few thousand places on both."""
    s, t = np.meshgrid(np.linspace(0, 1, 81), np.linspace(0, 1, 81))
    s, t = s.ravel(), t.ravel()
    if edges:
        z = np.outer(1 - s, p[0]) + np.outer(s, p[1]) - np.outer(1 - t, p[2]) - np.outer(t, p[3])
    else:
        inside = s + t <= 1.0
        s, t = s[inside], t[inside]
        z = p[0] - np.outer(1 - s - t, p[1]) - np.outer(s, p[2]) - np.outer(t, p[3])
    return float(np.linalg.norm(z, axis=1).min())


FLAT = (1.0, 1.0, 1e-9)
SHAPES = {"any": (1.0, 1.0, 1.0), "in a plane": FLAT, "needles": (1.0, 1e-6, 1e-6), "near a line": (1.0, 1e-3, 0.0)}


@pytest.mark.parametrize("edges", [False, True], ids=["point-triangle", "edge-edge"])
@pytest.mark.parametrize("shape", SHAPES)
def test_distances_are_the_least_of_all_places(shape, edges):
    for seed in range(40):
        p = np.random.default_rng(seed).normal(size=(4, 3)) * SHAPES[shape]
        found, least = compute_distances(pair(edges), p)[0], sample_distance(p, edges)
        # A place of the finest sampling is at most a cell of 1/80 from the nearest: the lengths here are below 6 m.
        assert least - 6.0 / 80 <= found <= least + 1e-12


def test_parallel_and_coincident_edges_have_their_distance():
    p = np.array([[0, 0, 0], [1, 0, 0], [0.5, 0.3, 0], [2, 0.3, 0]], float)
    assert compute_distances(pair(True), p)[0] == pytest.approx(0.3, rel=1e-14)
    assert compute_distances(pair(True), p[[0, 1, 0, 1]])[0] == 0.0
    assert compute_distances(pair(False), np.array([[0.2, 0.2, 0.1], [0, 0, 0], [1, 0, 0], [0, 1, 0.0]]))[0] == 0.1


def test_gradients_and_second_derivatives_are_those_of_the_value():
    contact, p, _ = build_touching_sheets()
    gradient, h = np.zeros_like(p), 1e-6
    contact.add_gradient(p, gradient)
    hessian = contact.hessian(p)
    pairs, which = contact.find_candidates(p), contact.hessian_blocks(p).vertices
    assert len(which) > 300
    assert (pairs.mollifier_threshold > 0.0).any()
    for seed in range(3):
        d = random_displacement(seed, p, 1.0)
        change = (contact.value(p + h * d) - contact.value(p - h * d)) / (2 * h)
        # Central differences: the third derivative, 1/gap times the second, by h^2, and round-off over h.
        assert change == pytest.approx(float((gradient * d).sum()), rel=1e-6, abs=1e-6)
        ahead, behind = np.zeros_like(p), np.zeros_like(p)
        contact.add_gradient(p + h * d, ahead)
        contact.add_gradient(p - h * d, behind)
        bent = (ahead - behind).ravel() / (2 * h)
        np.testing.assert_allclose(hessian @ d.ravel(), bent, atol=1e-5 * np.abs(bent).max())


def test_the_mollifier_is_part_of_the_derivatives():
    contact, p, _ = build_touching_sheets(noise=2e-4)  # edges that run in parallel but for a hundredth
    d, h, gradient = random_displacement(1, p, 1.0), 1e-7, np.zeros_like(p)
    contact.add_gradient(p, gradient)
    change = (contact.value(p + h * d) - contact.value(p - h * d)) / (2 * h)
    assert change == pytest.approx(float((gradient * d).sum()), rel=1e-5)


@pytest.mark.parametrize("noise", [2e-4, 4e-3])
def test_clamped_blocks_are_positive_semidefinite_and_never_less_than_exact_ones(noise):
    contact, p, _ = build_touching_sheets(noise=noise)
    exact, half, clamped = (contact.hessian_blocks(p, keep).values for keep in (1.0, 0.5, 0.0))
    size = np.abs(clamped).max(axis=(1, 2))
    # Round-off of blocks of 12 x 12.
    assert (np.linalg.eigvalsh(clamped)[:, 0] >= -1e-13 * size).all()
    assert (np.linalg.eigvalsh(clamped - exact)[:, 0] >= -1e-13 * size).all()
    np.testing.assert_allclose(half, 0.5 * (exact + clamped), atol=1e-13 * size.max())
    assert np.linalg.eigvalsh(exact)[:, 0].min() < 0.0


@pytest.mark.parametrize("bent", [0.0, 1e-60, 1e-20, 1e-9])
def test_edges_on_nearly_one_line_have_blocks_of_the_size_of_all_others(bent):
    # A straight chain, pushed together: what is divided by the mollifier has to vanish as it does.
    rest = np.zeros((4, 3))
    rest[:, 0] = 0.03 * np.arange(4)
    edges = np.array([[0, 1], [1, 2], [2, 3]])
    contact = SelfContact(
        CollisionMesh.from_rest_shape(rest, edges, edges[:, [0, 1, 1]], np.ones(4), CONTACT_THICKNESS, CONTACT_DHAT)
    )
    p = rest * (0.9, 1.0, 1.0)
    p[1:, 1] = bent
    exact, clamped = (contact.hessian_blocks(p, keep).values for keep in (1.0, 0.0))
    assert len(exact) == 5  # two edges, and four vertices with edges next to their own
    assert np.abs(clamped).max() < 10 * np.abs(exact).max()
    assert np.linalg.eigvalsh(clamped)[:, 0].min() >= -1e-13 * np.abs(clamped).max()


def test_ropes_side_by_side_press_upon_each_other():
    rest = np.array([[x, y, 0.0] for y in (0.0, 0.2) for x in (0.0, 0.1, 0.2, 0.3)])
    edges = np.array([[0, 1], [1, 2], [2, 3], [4, 5], [5, 6], [6, 7]])
    contact = SelfContact(
        CollisionMesh.from_rest_shape(rest, edges, edges[:, [0, 1, 1]], np.ones(8), CONTACT_THICKNESS, CONTACT_DHAT)
    )
    p, g = rest.copy(), np.zeros((8, 3))
    p[4:, 1] = CONTACT_THICKNESS + 0.5 * CONTACT_DHAT
    contact.add_gradient(p, g)
    assert (g[:4, 1] > 0.0).all()
    assert (g[4:, 1] < 0.0).all()
    assert np.isinf(contact.value(p - [[0.0, y, 0.0] for y in [0.0] * 4 + [0.51 * CONTACT_DHAT] * 4]))


def test_forces_have_no_sum_and_no_moment():
    contact, p, _ = build_touching_sheets()
    g = np.zeros_like(p)
    contact.add_gradient(p, g)
    assert np.abs(g.sum(axis=0)).max() <= 1e-13 * np.abs(g).sum()
    assert np.abs(np.cross(p, g).sum(axis=0)).max() <= 1e-13 * np.abs(g).sum()


def test_candidates_are_all_that_are_near():
    contact, p, triangles = build_touching_sheets()
    surface, reach = contact.collision_mesh, 2 * contact.activation_distance
    edges = unique_edges(triangles)
    expected = [(i, *t) for i in range(len(p)) for t in triangles.tolist() if i not in t]
    expected += [(*e, *f) for e, f in combinations(edges.tolist(), 2) if not set(e) & set(f)]
    first = sum(1 for _ in range(len(p)) for _ in triangles) - 3 * len(triangles)
    one = np.ones(len(expected))
    every = Candidates(np.array(expected), first, one, one, 0 * one, CONTACT_THICKNESS, CONTACT_DHAT)
    near = compute_distances(every, p) < reach
    found = surface.find_proximity_candidates(p, reach)
    assert name_pairs(found.vertices, found.num_point_triangle) == name_pairs(
        every.vertices[near], int(near[:first].sum())
    )
    assert len(found.vertices) == int(near.sum())


def name_pairs(vertices: np.ndarray, points: int) -> set[Any]:
    """Points with their triangles, and edges with each other, whichever of two comes first."""
    one, two = vertices[:points].tolist(), vertices[points:].tolist()
    return {tuple(x) for x in one} | {frozenset((tuple(x[:2]), tuple(x[2:]))) for x in two}


def test_each_contact_stands_for_all_pairs_that_have_its_closest_points():
    contact, p, _ = build_touching_sheets(noise=5e-4)
    pairs, total, gradient = contact.find_candidates(p), 0.0, np.zeros_like(p)
    for e in range(len(pairs.vertices)):
        cut = {
            name: getattr(pairs, name)[e : e + 1]
            for name in ("vertices", "distance_scale", "stiffness", "mollifier_threshold")
        }
        single = pairs._replace(num_point_triangle=int(e < pairs.num_point_triangle), **cut)
        total += energy_and_gradient(
            build_collisions(single, pad_positions(p), allocate_collisions(1, CONTACT_THICKNESS, CONTACT_DHAT)),
            p,
            gradient,
        )
    met, summed = contact.hessian_blocks(p), np.zeros_like(p)
    contact.add_gradient(p, summed)
    near = int((compute_distances(pairs, p) < CONTACT_THICKNESS + CONTACT_DHAT).sum())
    assert len(met.vertices) < 0.7 * near
    assert (met.vertices[:, 2] < 0).sum() > 20  # of a point and a point
    # The same sums in another order.
    assert contact.value(p) == pytest.approx(total, rel=1e-13)
    np.testing.assert_allclose(summed, gradient, atol=1e-13 * np.abs(gradient).max())


def test_stored_kernels_change_no_bit():
    contact, p, _ = build_touching_sheets()
    fresh = SelfContact(contact.collision_mesh)
    contact.value(p)
    for seed in range(4):
        q = p + random_displacement(seed, p, 1e-3)
        assert contact.value(q) == SelfContact(contact.collision_mesh).value(q)
        assert abs(contact.hessian(q) - fresh.hessian(q)).max() == 0.0


def test_candidates_are_found_again_before_a_pair_outside_comes_into_range():
    """Of three triangles above each other, two in range, the third comes down from where it is no candidate."""
    layer = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    triangles, limit = np.arange(9).reshape(3, 3), CONTACT_THICKNESS + CONTACT_DHAT

    def at(*heights: float) -> np.ndarray:
        return np.concatenate([layer + np.array([0.0, 0.0, z]) for z in heights])

    contact = SelfContact(
        CollisionMesh.from_rest_shape(
            at(0, 1, 2), unique_edges(triangles), triangles, np.ones(9), CONTACT_THICKNESS, CONTACT_DHAT
        )
    )
    contact.value(at(0.0, 0.9 * limit, (0.9 + 1.02 * CACHE_INFLATION) * limit))
    before = contact.candidate_caches[0]
    assert len(before.candidates.vertices)
    assert before.candidates.vertices.max() < 6
    q = at(0.0, 0.9 * limit, (0.9 + 1.02 * CACHE_INFLATION - 0.6) * limit)
    assert contact.value(q) == SelfContact(contact.collision_mesh).value(q) > contact.value(at(0.0, 0.9 * limit, 2.0))


@pytest.mark.parametrize("fast", [1e-3, 0.05, 1.0])
def test_no_gap_closes_within_the_largest_step_and_none_would_be_much_larger(fast):
    contact, p, triangles = build_touching_sheets(noise=1e-3)
    edges, upper = unique_edges(triangles), np.arange(len(p)) >= len(p) // 2
    for seed in range(3):
        d = random_displacement(seed, p, 0.2 * fast)
        d[upper] -= (0.0, fast, 0.0)
        most = contact.collision_free_step_size(p, d)
        assert (
            most
            == exhaustive_step_size(contact, p, d)
            == SelfContact(contact.collision_mesh).collision_free_step_size(p, d)
        )
        for t in np.linspace(0.0, most, 60):
            assert not contact.find_violated_pairs(p + t * d)
            assert not find_edge_triangle_intersections(p + t * d, edges, triangles)
        # It leaves a tenth of the gap, where the search ends: twice as far something is nearer than the thickness.
        assert most == 1.0 or any(contact.find_violated_pairs(p + t * most * d) for t in np.linspace(1.0, 2.0, 40))


def test_a_common_motion_bounds_no_step():
    contact, p, _ = build_touching_sheets()
    assert contact.collision_free_step_size(p, np.tile([1e3, 0.0, -1e3], (len(p), 1))) == 1.0


def test_pairs_that_are_near_at_rest_preserve_their_distance_in_proportion():
    contact, _, triangles = build_touching_sheets()
    assert isinstance(contact.collision_mesh, CollisionMesh)
    fine = CollisionMesh.from_rest_shape(
        *_shrunk(0.05),
        unique_edges(triangles),
        triangles,
        contact.collision_mesh.stiffness,
        CONTACT_THICKNESS,
        CONTACT_DHAT,
    )
    assert len(fine.rest_close_pairs[0]) > 100
    rest = _shrunk(0.05)[0]
    assert SelfContact(fine).value(rest) == 0.0
    assert SelfContact(fine).value(rest * (0.5, 1.0, 0.5)) > 0.0
    assert not SelfContact(fine).find_violated_pairs(rest)


def _shrunk(by: float):
    _, p, _ = build_touching_sheets(noise=0.0)
    return (p * (by, 1.0, by),)


@pytest.mark.parametrize("gap", [1e-2, 1e-5, 1e-7, 1e-9])
def test_forces_are_the_slope_of_the_value_down_to_gaps_of_round_off(gap: float):
    p = np.array([[0.2, CONTACT_THICKNESS + gap * CONTACT_DHAT, 0.2], [0, 0, 0], [0, 0, 1], [1, 0, 0]], float)
    out, x = compute_gradient(pair(False), p), (p[0, 1] - CONTACT_THICKNESS) / CONTACT_DHAT
    slope = (1 - x) * (2 * np.log(x) - (1 - x) / x)
    assert out[0, 1] == pytest.approx(CONTACT_DHAT * slope, rel=1e-6)
    closed = p - [[0, 2 * gap * CONTACT_DHAT, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert -2e6 * CONTACT_DHAT < compute_gradient(pair(False), closed)[0, 1] < 0.0  # finite, and apart


def test_friction_of_nearly_parallel_edges_has_the_barriers_force():
    """Edges of a metre whose sine is the square root of e/2: the mollifier is (2 - 1/2)/2."""
    sine = np.sqrt(0.5e-3)
    away = 0.5 * np.array([np.sqrt(1.0 - sine**2), 0.0, sine])
    apart = np.array([0.0, CONTACT_THICKNESS + 0.5 * CONTACT_DHAT, 0.0])
    p = np.array([[-0.5, 0, 0], [0.5, 0, 0], apart - away, apart + away])
    pairs, out = pair(True)._replace(mollifier_threshold=np.array([1e-3])), np.empty(1)
    compute_normal_forces(
        build_collisions(pairs, pad_positions(p), allocate_collisions(1, CONTACT_THICKNESS, CONTACT_DHAT)), out
    )
    assert out[0] == pytest.approx(0.75 * CONTACT_DHAT * 0.5 * (1.0 + 2.0 * np.log(2.0)), rel=1e-9)


def test_values_are_infinite_where_a_gap_is_closed():
    contact, p, _ = build_touching_sheets()
    p[len(p) // 2 :, 1] -= 0.03
    assert contact.value(p) == np.inf
    assert contact.find_violated_pairs(p)
    assert contact.collision_free_step_size(p, random_displacement(0, p, 1.0)) == 0.0


def test_crossings_are_found_exactly_and_touching_counts():
    square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    one = np.array([[0, 1, 2]])
    for low, meets in ((-0.5, True), (0.0, True), (1e-300, False)):
        p = np.concatenate([square, [[0.25, 0.25, low], [0.25, 0.25, 1.0]]])
        assert bool(find_edge_triangle_intersections(p, np.array([[3, 4]]), one)) is meets
    flat = np.concatenate([square, [[0.25, 0.25, 0], [2, 2, 0], [1.0, 1.0, 0], [2, 1, 0]]])
    assert find_edge_triangle_intersections(flat, np.array([[3, 4], [5, 6]]), one) == [((3, 4), (0, 1, 2))]
    assert not find_edge_triangle_intersections(flat, np.array([[0, 4]]), one)  # they share a vertex


def test_rational_arithmetic_decides_what_round_off_leaves_open_and_nothing_else(monkeypatch: pytest.MonkeyPatch):
    rng, triangles = np.random.default_rng(0), np.arange(120).reshape(40, 3)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    clear = rng.random((120, 3))
    touching = rng.integers(0, 3, (120, 3)).astype(float)  # on a lattice: most pairs touch or are degenerate
    found = [find_edge_triangle_intersections(p, edges, triangles) for p in (clear, touching)]
    assert all(len(one) > 100 for one in found)
    with monkeypatch.context() as patched:
        patched.setattr(edge_triangle_intersections, "_intersects_certainly", lambda p, e, t: np.zeros(len(e), bool))
        assert [find_edge_triangle_intersections(p, edges, triangles) for p in (clear, touching)] == found
    asked = list[bool]()
    exact = edge_triangle_intersections.edge_intersects_triangle
    monkeypatch.setattr(
        edge_triangle_intersections,
        "edge_intersects_triangle",
        lambda edge, triangle: asked.append(exact(edge, triangle)) or asked[-1],
    )
    assert find_edge_triangle_intersections(clear, edges, triangles) == found[0]
    assert not asked


def test_crossings_agree_with_the_intersection_test_of_ipctk():
    ipctk = pytest.importorskip("ipctk", reason="the reference is an optional extra")
    for seed in range(12):
        _, p, triangles = build_touching_sheets(seed, noise=0.002 * seed)
        edges = unique_edges(triangles)
        mesh = ipctk.CollisionMesh(p, edges, triangles)
        assert bool(find_edge_triangle_intersections(p, edges, triangles)) == ipctk.has_intersections(mesh, p)


@pytest.mark.parametrize("keep", [1.0, 0.7, 0.0])
def test_a_steps_matrix_has_all_blocks_while_contacts_come_and_go(keep):
    contact, p, _ = build_touching_sheets(noise=2e-4)  # mollified edges among them
    system, still = System(np.full(len(p), 10.0), 0.1, (contact,)), np.zeros_like(p)
    start = StepStart(p, still, 0.0, p, system.velocity_rate, 0.1)
    step = StepObjective(FixedObjective(system), StepProblem(system, p, still, p[:0], p, p, start))
    matrices, met, shift = set[int](), set[int](), 1e6
    for seed in range(4):
        q = p + random_displacement(seed, p, 2e-3)
        hessian, b = step.hessian(q), random_displacement(9, p, 1.0)
        assert hessian.factorise(keep, shift)
        x = hessian.solve(b)
        product = (system.inertia_diagonal[:, None] + shift) * x
        contact.hessian_blocks(q, keep).add_product(x, product)
        # Blocks of up to 1e7 N/m and of 1e6.
        np.testing.assert_allclose(product, b, atol=1e-12)
        matrices.add(id(hessian.assemble_clamped()))
        met.add(len(contact.hessian_blocks(q).vertices))
    assert len(met) == 4
    assert len(matrices) == 1


def test_solves_with_the_same_pattern_positions_share_a_matrix():
    contact, p, _ = build_touching_sheets(noise=2e-4)
    system, still = System(np.full(len(p), 10.0), 0.1, (contact,)), np.zeros_like(p)
    matrices = {True: list[BlockMatrix](), False: list[BlockMatrix]()}
    for is_shared, found in matrices.items():
        objective = FixedObjective(system)
        for seed in range(3):
            q = p + random_displacement(seed, p, 1.2e-2)
            near = p if is_shared else None
            start = StepStart(p, still, 0.0, p, system.velocity_rate, 0.1, pattern_positions=near)
            step = StepObjective(objective, StepProblem(system, p, still, p[:0], p, q, start))
            found.append(step.hessian(q).assemble_clamped())
    assert len({id(matrix) for matrix in matrices[True]}) == 1
    assert len({id(matrix) for matrix in matrices[False]}) == 3


def test_memory_is_reused_when_nothing_refers_to_it():
    room = ReusableBuffer()
    one = room.acquire_array(5)
    one[:] = 1.0
    other = room.acquire_array(4)
    other[:] = 2.0
    assert (one == 1.0).all()
    at = other.ctypes.data
    del other
    assert room.acquire_array(3).ctypes.data == at
