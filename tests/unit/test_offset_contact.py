"""Offset geometric contact: activation, offset blocks, displacement bounds, the forces of a vertex, and the solver."""

from __future__ import annotations

from itertools import islice
from typing import Any

import numpy as np
import pytest
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.stack_mesh import StackMesh
from springbench.harness.scenes.primitive_obstacles import PlaneObstacle
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.vertex_selectors import BoxRegion
from springbench.harness.simulation.instrumentation_pass import count_intersections
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.collisions import Candidates, pad_positions
from springbench.solvers.contact.contact_potential import BarrierContact, SelfContact
from springbench.solvers.contact.potentials.barrier import compute_distances
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.methods.vertex_block.offset_blocks import SurfaceAdjacency, find_offset_contacts
from springbench.solvers.methods.vertex_block.offset_detection import OffsetSurface
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.methods.vertex_block.vbd_offset_contact import OffsetContactDescent, fill_row_entries
from springbench.solvers.methods.vertex_block.vbd_offset_sweeps import OffsetContacts, add_offset_contacts, offset_force
from springbench.solvers.model.step_problem import Positions, StopRule, Unsupported

from tests.scene_builders import build_test_scene
from tests.self_contact_scenes import CONTACT_DHAT, CONTACT_THICKNESS, build_touching_sheets

RADIUS = 0.03
FRACTION = OffsetContactDescent().bound_fraction


@jit_kernel
def evaluate_offset_activation(distances, radius, value, force, curvature):
    """Write g, -g' and g'' of positive distances."""
    for k in range(len(distances)):
        d = distances[k]
        force[k], curvature[k] = offset_force(d, radius)
        if 2.0 * d >= radius:
            value[k] = 0.5 * max(0.0, radius - d) ** 2
        else:
            value[k] = 0.25 * radius * radius * (0.5 - np.log(2.0 * d / radius))


def activation(distances: Any, radius: float = RADIUS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    d = np.atleast_1d(np.asarray(distances, np.float64))
    value, force, curvature = np.empty_like(d), np.empty_like(d), np.empty_like(d)
    evaluate_offset_activation(d, radius, value, force, curvature)
    return value, force, curvature


def test_the_activation_has_its_own_derivatives():
    d, h = np.concatenate([np.geomspace(1e-4, 0.49, 20), np.linspace(0.51, 0.99, 20), [1.01, 2.0]]) * RADIUS, 1e-6
    _, force, curvature = activation(d)
    (up, more, _), (down, less, _) = activation(d * (1 + h)), activation(d * (1 - h))
    np.testing.assert_allclose(-force, (up - down) / (2 * h * d), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(curvature, -(more - less) / (2 * h * d), rtol=1e-8, atol=1e-9)


def test_the_activation_is_twice_continuously_differentiable_at_half_its_radius():
    for at, expected in ((0.5, (RADIUS**2 / 8, RADIUS / 2, 1.0)), (1.0, (0.0, 0.0, None))):
        for name, below, above, value in zip(
            ("value", "force", "curvature"), *(activation(at * RADIUS * (1 + e)) for e in (-1e-12, 1e-12)), expected,
            strict=True,
        ):  # fmt: skip
            if value is not None:  # the curvature jumps at the radius
                assert below == pytest.approx(value, rel=1e-10, abs=1e-13), name
                assert above == pytest.approx(value, rel=1e-10, abs=1e-13), name


def test_the_activation_is_that_of_ipctk():
    ipctk = pytest.importorskip("ipctk", reason="the reference is an optional extra")
    d = np.linspace(1e-3, 1.1, 60) * RADIUS
    value, force, curvature = activation(d)
    barrier = ipctk.TwoStageBarrier()
    np.testing.assert_allclose(value, [barrier(x, RADIUS) for x in d], rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(-force, [barrier.first_derivative(x, RADIUS) for x in d], rtol=1e-12, atol=1e-16)
    np.testing.assert_allclose(curvature, [barrier.second_derivative(x, RADIUS) for x in d], rtol=1e-12)


def build_crumpled_sheets(seed: int) -> tuple[SelfContact, Positions, np.ndarray]:
    """Two sheets that touch, with vertices displaced by a third of the cells: all kinds of closest features."""
    contact, p, triangles = build_touching_sheets(seed, size=5, noise=0.0)
    rng = np.random.default_rng(seed)
    return contact, p + rng.uniform(-1.0, 1.0, p.shape) * (0.08, 0.006, 0.08), triangles


def collision_mesh_of(contact: BarrierContact) -> CollisionMesh:
    """The mesh of a contact without obstacles."""
    assert isinstance(contact.collision_mesh, CollisionMesh)
    return contact.collision_mesh


def blocks(contact: SelfContact, p: Positions, radius: float) -> tuple[Candidates, np.ndarray, np.ndarray]:
    mesh = collision_mesh_of(contact)
    pairs = mesh.find_proximity_candidates(p, radius)
    adjacency = SurfaceAdjacency.from_primitives(mesh.edges.primitives, mesh.triangles.primitives, len(p))
    touches, clearance = np.empty(len(pairs.vertices), bool), np.full(len(p), np.inf)
    gap = np.empty(len(pairs.vertices))
    find_offset_contacts(
        adjacency, pairs._replace(dhat=np.inf), pad_positions(p), np.inf, FRACTION, gap, touches, clearance
    )
    return pairs, touches, clearance


@pytest.mark.parametrize("seed", range(3))
def test_the_pairs_in_contact_are_those_of_ipctk(seed):
    ipctk = pytest.importorskip("ipctk", reason="the reference is an optional extra")
    contact, p, triangles = build_crumpled_sheets(seed)
    edges = collision_mesh_of(contact).edges.primitives
    mesh = ipctk.CollisionMesh(p, edges, triangles)
    mesh.init_adjacencies()
    edge_of = {tuple(sorted(edge)): k for k, edge in enumerate(mesh.edges.tolist())}
    face_of = {tuple(sorted(face)): k for k, face in enumerate(mesh.faces.tolist())}
    pairs, touches, _ = blocks(contact, p, 0.15)
    expected = []
    for e, v in enumerate(pairs.vertices.tolist()):
        if e < pairs.num_point_triangle:
            pair = ipctk.FaceVertexCandidate(face_of[tuple(sorted(v[1:]))], v[0])
            expected.append(ipctk.ogc.is_face_vertex_feasible(mesh, p, pair, ipctk.PointTriangleDistanceType.AUTO))
        else:
            pair = ipctk.EdgeEdgeCandidate(edge_of[tuple(sorted(v[:2]))], edge_of[tuple(sorted(v[2:]))])
            expected.append(ipctk.ogc.is_edge_edge_feasible(mesh, p, pair, ipctk.EdgeEdgeDistanceType.AUTO))
    assert 0.02 < np.mean(expected) < 0.9
    np.testing.assert_array_equal(touches, expected)


def test_clearances_are_the_smallest_gaps_of_all_pairs():
    contact, p, _ = build_crumpled_sheets(0)
    pairs, _, clearance = blocks(contact, p, 0.15)
    gaps = compute_distances(pairs, p) - pairs.distance_scale * pairs.min_distance
    expected = np.full(len(p), np.inf)
    np.minimum.at(expected, pairs.vertices.ravel(), np.repeat(gaps, 4))
    np.testing.assert_allclose(clearance, expected, rtol=1e-12)


def displace_vertices(seed: int, p: Positions, bound: np.ndarray, share: float) -> Positions:
    """Each vertex displaced by a share of its bound: at random, or up and down towards the other sheet."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=p.shape)
    if seed % 2:
        direction = np.zeros_like(p)
        direction[:, 1] = np.where(np.arange(len(p)) < len(p) // 2, 1.0, -1.0)
    return p + share * bound[:, None] * direction / np.linalg.norm(direction, axis=1)[:, None]


def test_triangles_without_edges_have_an_adjacency():
    rest, edges = np.random.default_rng(0).uniform(size=(6, 3)), np.array([[0, 1], [1, 2]])
    mesh = CollisionMesh.from_rest_shape(rest, edges, np.array([[0, 1, 2], [3, 4, 5]]), np.ones(6), 1e-6, 1e-6)
    adjacency = OffsetSurface.from_contact(SelfContact(mesh)).adjacency
    assert adjacency.edge_starts.tolist() == [0, 1, 3, 4, 4, 4, 4]
    assert adjacency.triangle_starts.tolist() == list(range(7))


@pytest.mark.parametrize("share", [1.0, 0.5])
@pytest.mark.parametrize("seed", range(8))
def test_displacements_within_their_bounds_never_collide(seed, share):
    ipctk = pytest.importorskip("ipctk", reason="the reference is an optional extra")
    contact, p, triangles = build_crumpled_sheets(seed)
    mesh = ipctk.CollisionMesh(p, collision_mesh_of(contact).edges.primitives, triangles)
    clearance = OffsetSurface.from_contact(contact).detect_contacts(contact, p, 0.1, FRACTION).clearance
    assert (clearance > 0.0).all()
    q = displace_vertices(seed, p, FRACTION * clearance, share)
    assert ipctk.is_step_collision_free(mesh, p, q)
    assert not contact.find_violated_pairs(q)


def test_larger_displacements_do_collide():
    ipctk = pytest.importorskip("ipctk", reason="the reference is an optional extra")
    contact, p, triangles = build_crumpled_sheets(1)
    mesh = ipctk.CollisionMesh(p, collision_mesh_of(contact).edges.primitives, triangles)
    found = OffsetSurface.from_contact(contact).detect_contacts(contact, p, 0.1, FRACTION)
    assert not ipctk.is_step_collision_free(mesh, p, displace_vertices(1, p, found.clearance + CONTACT_THICKNESS, 0.6))


@jit_kernel
def vertex_terms(contacts, i, p, gradient, block):
    """Write the gradient (3,) and block (6,) of a row."""
    nothing = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    g, h = add_offset_contacts(contacts, i, p, *nothing)
    for k in range(3):
        gradient[k] = g[k]
    for k in range(6):
        block[k] = h[k]


def single_contact(x: np.ndarray, edges: bool, friction: float, start: np.ndarray) -> OffsetContacts:
    starts, entries = np.zeros(5, np.int64), np.empty((2, 4), np.int64)
    fill_row_entries(np.arange(4)[None], starts, entries)
    one = np.ones(1)
    return OffsetContacts(
        starts, entries[0], entries[1], np.ones(1, bool), 4 * np.arange(4)[None], np.array([edges]),
        CONTACT_THICKNESS * one, CONTACT_DHAT * one, 7.0 * one, friction * one, 1e-4 * one, x, np.ones(4), start,
    )  # fmt: skip


def evaluate_pair(x: np.ndarray, edges: bool, i: int, friction: float = 0.0, start: np.ndarray | None = None):
    rows = pad_positions(x).ravel()
    gradient, block = np.empty(3), np.empty(6)
    before = rows if start is None else pad_positions(start).ravel()
    vertex_terms(single_contact(rows, edges, friction, before), i, rows, gradient, block)
    a, b, c, d, e, f = block
    return gradient, np.array([[a, b, c], [b, d, e], [c, e, f]])


def energy(x: np.ndarray, edges: bool) -> float:
    one = np.ones(1)
    pair = Candidates(np.arange(4)[None], 0 if edges else 1, one, one, 0 * one, 0.0, 1.0)
    gap = compute_distances(pair, x) - CONTACT_THICKNESS
    return 7.0 * float(activation(gap, CONTACT_DHAT)[0][0])


PLACES = {
    False: np.array([[0.2, 0.035, 0.1], [0.0, 0.0, 0.0], [1.0, 0.01, 0.0], [0.0, -0.02, 1.0]]),
    True: np.array([[-0.5, 0.035, 0.1], [0.6, 0.035, 0.0], [0.1, 0.0, -0.4], [0.0, 0.0, 0.7]]),
}


@pytest.mark.parametrize("edges", [False, True])
@pytest.mark.parametrize("gap", [0.2, 0.8])
def test_the_forces_of_vertices_are_derivatives_of_the_activation(edges, gap):
    x, h = PLACES[edges].copy(), 1e-7
    ends = 2 if edges else 1
    x[:ends, 1] += CONTACT_THICKNESS + gap * CONTACT_DHAT - 0.035
    found = [evaluate_pair(x, edges, i) for i in range(4)]
    for i in range(4):
        for k in range(3):
            up, down = x.copy(), x.copy()
            up[i, k] += h
            down[i, k] -= h
            assert found[i][0][k] == pytest.approx((energy(up, edges) - energy(down, edges)) / (2 * h), abs=1e-7)
    np.testing.assert_allclose(sum(gradient for gradient, _ in found), 0.0, atol=1e-12)
    # A translation of the first feature along the normal changes the distance alone.
    force = np.linalg.norm(sum(gradient for gradient, _ in found[:ends]))
    n = found[0][0] / np.linalg.norm(found[0][0])
    values = [energy(x + s * n * (np.arange(4) < ends)[:, None], edges) for s in (-1e-5, 0.0, 1e-5)]
    curvature = float((values[0] - 2 * values[1] + values[2]) / 1e-10)
    for gradient, block in found:
        share = float((np.linalg.norm(gradient) / force) ** 2)
        np.testing.assert_allclose(block, share * curvature * np.outer(n, n), rtol=0, atol=1e-4 * share * curvature)


@pytest.mark.parametrize("slip", [5e-5, 2e-3])
def test_friction_is_coulombs_smoothed_below_its_length(slip):
    x = PLACES[False].copy()
    x[1:, 1] = 0.0
    x[0, 1] = CONTACT_THICKNESS + 0.4 * CONTACT_DHAT
    start = x.copy()
    start[0, 0] -= slip
    pressed, _ = evaluate_pair(x, False, 0)
    rough, block = evaluate_pair(x, False, 0, 0.5, start)
    np.testing.assert_allclose(rough - pressed, (0.5 * abs(pressed[1]) * min(1.0, slip / 1e-4), 0.0, 0.0), atol=1e-13)
    assert block[0, 0] == pytest.approx(0.5 * abs(pressed[1]) / max(slip, 1e-4))


SELF_CONTACT = SelfContactEffect(min_distance=0.01, friction=0.3)


def pressed_sheets(*effects: Any) -> Scene:
    """Two sheets, of which the upper one falls onto the lower one, which is pinned."""
    pins = PinsEffect(box=BoxRegion(low=(-9.0, -0.01, -9.0), high=(9.0, 0.01, 9.0)))
    springs = SpringsEffect(stretch=100.0, shear=20.0)
    return build_test_scene(StackMesh(layer_spacing=0.03), springs, GravityEffect(), pins, *effects, size=5)


def test_sheets_that_meet_stay_apart_and_every_frame_is_reached_without_collision():
    ipctk = pytest.importorskip("ipctk", reason="the reference is an optional extra")
    made = pressed_sheets(SELF_CONTACT)
    (contact,) = (energy for energy in made.system.energies if isinstance(energy, BarrierContact))
    edges = collision_mesh_of(contact).edges.primitives
    p, touched = build_initial_state(made).motion.positions, 0
    steps = simulate_scene(
        made, prepare(made, OffsetContactDescent()), StopRule(40), initial_guess="previous", frames=15
    )
    mesh = ipctk.CollisionMesh(p, edges, made.mesh.triangles)
    for step in steps:
        assert count_intersections(made, step.positions, 0.0) == 0
        assert not contact.find_violated_pairs(step.positions)
        assert ipctk.is_step_collision_free(mesh, p, step.positions)
        assert len(step.iteration_counts) == 1  # friction needs no further solves
        p = step.positions.copy()
        touched += contact.value(p) > 0.0
    assert touched > 5


def test_solves_repeat_to_the_last_bit_and_end_at_the_iterate_of_their_number():
    made = pressed_sheets(SELF_CONTACT)
    *_, last = simulate_scene(
        made, prepare(made, OffsetContactDescent()), StopRule(40), initial_guess="previous", frames=6
    )
    problem = build_problem(made, last.state, "previous")
    path = [p.copy() for p in islice(prepare(made, OffsetContactDescent()).iterates(problem), 12)]
    for count in (1, 5, 12):
        prepared = prepare(made, OffsetContactDescent())
        for _ in range(2):  # the second solve has the candidates of the first
            solution = prepared.solve(problem, StopRule(count, 1e-3))
            np.testing.assert_array_equal(solution.positions, path[count - 1])
            assert solution.num_iterations == count
            assert np.isnan(solution.residual)


def test_without_contact_of_surfaces_the_sweeps_are_those_of_vbd():
    made = pressed_sheets()
    problem = build_problem(made, build_initial_state(made), "previous")
    end, expected = (
        solver.prepare(made.system).solve(problem, StopRule(7)).positions
        for solver in (OffsetContactDescent(), VertexBlockDescent())
    )
    np.testing.assert_array_equal(end, expected)


def test_contact_of_vertices_and_of_surfaces_are_refused_together():
    plane = PlaneObstacle(point=(0.0, -1.0, 0.0))
    both = ContactEffect(obstacles=(plane,)), SurfaceContactEffect(obstacles=(plane,))
    made = build_test_scene(GridMesh(), SpringsEffect(stretch=100.0), *both, size=3)
    with pytest.raises(Unsupported, match=r"vbd-ogc: .*surface-contact with the same obstacles"):
        OffsetContactDescent().prepare(made.system)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"bound_fraction": 0.5}, "bound_fraction: should be positive and less than 0.5"),
        ({"redetection_fraction": 1.0}, "redetection_fraction"),
        ({"spectral_radius": 1.0}, "spectral_radius"),
    ],
)
def test_parameters_out_of_range_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        OffsetContactDescent(**given)
