"""Strain limits and dashpots in the packets of springs: gradient, energy and vertex blocks against the energies."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.kernels.edge_elements import AttachedEdges
from springbench.solvers.kernels.spring_local_step import SpringPackets, add_descent, add_projection
from springbench.solvers.kernels.spring_objective import ObjectiveWeights, value_and_descent
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.methods.vertex_block.vbd_packets import (
    PACKET_SCRATCH_SIZE,
    SPRING_SCRATCH_SIZE,
    vbd_model_step,
    vbd_vertex_model,
)
from springbench.solvers.model.energies.dashpot_energy import Dashpots
from springbench.solvers.model.energies.edge_energy import rest_directions
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits
from springbench.solvers.simd.spring_packets import LANES

NUM_VERTICES, NUM_SPRINGS = 21, 60
FIXED_VERTEX = NUM_VERTICES - 1
ANCHOR_STIFFNESS = 5.0
ROUNDOFF = 1e-13


class Network(NamedTuple):
    """Springs with limits and dashpots, some on a pair twice, some where no spring is, and packets of them."""

    springs: Springs
    energies: list[StrainLimits | Dashpots]
    packets: SpringPackets
    positions: NDArray[np.float64]
    weights: ObjectiveWeights


def build_network(kind: str, *, has_zero_length: bool = False) -> Network:
    """A random network; its last vertex does not move."""
    rng = np.random.default_rng(0)
    pairs = np.array([(i, j) for i in range(NUM_VERTICES) for j in range(i)])
    rng.shuffle(pairs)
    rest, p = rng.normal(size=(2, NUM_VERTICES, 3))
    springs = Springs.from_rest_shape(rest, pairs[:NUM_SPRINGS], rng.uniform(1.0, 2.0, NUM_SPRINGS))
    if has_zero_length:
        p[springs.edges[0, 0]] = p[springs.edges[0, 1]]
    # Half of the edges along springs, in either direction, the others elsewhere; the first ones twice.
    edges = pairs[NUM_SPRINGS // 2 : NUM_SPRINGS + 40].copy()
    edges[::3] = edges[::3, ::-1]
    edges = np.concatenate([edges, edges[:5, ::-1], springs.edges[:1]])
    k, length = rng.uniform(1.0, 2.0, (2, len(edges)))
    _, axis = rest_directions(rest, edges)
    energies = list[StrainLimits | Dashpots]()
    if "limits" in kind:
        energies.append(StrainLimits(edges, k, 0.8 * length, 1.5 * length, axis))
    if "dashpots" in kind:
        energies += [Dashpots(edges[:-6], k[:-6], axis[:-6], length[:-6])]
        energies += [
            Dashpots(edges[:3, ::-1], k[:3], -axis[:3], length[:3])
        ]  # on the same edges, in the other direction
    limits = tuple(e for e in energies if isinstance(e, StrainLimits))
    dashpots = tuple(e for e in energies if isinstance(e, Dashpots))
    part = np.zeros(NUM_VERTICES, np.int64)
    part[FIXED_VERTEX] = -1
    attached = AttachedEdges.from_energies(springs, limits, dashpots)
    where = np.arange(NUM_VERTICES), part, 1, NUM_VERTICES, NUM_VERTICES + 1
    packets, _ = SpringPackets.from_springs(springs, *where, attached)
    weights = ObjectiveWeights.from_packets(
        packets, np.full(NUM_VERTICES + 2, ANCHOR_STIFFNESS), np.array([FIXED_VERTEX])
    )
    assert packets.edges is not None
    if dashpots:
        joined = (np.concatenate([getattr(e, x) for e in dashpots]) for x in ("direction", "offset"))
        packets.edges.write_directions(*joined)
    return Network(springs, energies, packets, p, weights)


def evaluate_packets(packets, weights, x, right, near, descent, projection, value, models, changes):
    """Evaluate all packets; returned through the last arguments."""
    last = len(packets.packet_start) - 1
    value[0] = value_and_descent(packets, weights, x, right, descent[0])
    add_descent(packets, 0, last, x, right, descent[1], 0)
    add_projection(packets, 0, last, x, right, projection, 0)
    for b in range(last):
        vbd_vertex_model(packets, b, x, right, near, models[b])
        for k in range(9 * LANES):
            changes[b, k] = models[b, k]
        vbd_model_step(packets, b, x, right, near, changes[b])


evaluate_packets = jit_kernel(evaluate_packets)


class Evaluation(NamedTuple):
    """What packets give: energy [J], minus the gradient twice, A'K d, models of the vertices, steps and changes."""

    value: float
    descent: NDArray[np.float64]
    projection: NDArray[np.float64]
    models: NDArray[np.float64]
    changes: NDArray[np.float64]


def evaluate(network: Network, p: NDArray[np.float64], packets: SpringPackets | None = None) -> Evaluation:
    """Evaluate the packets of a network at p (n, 3), with the anchor stiffness."""
    packets = packets or network.packets
    rows = NUM_VERTICES + 2
    x = allocate_aligned(4 * rows)
    x.reshape(-1, 4)[:NUM_VERTICES, :3] = p
    x[-4] = 1e100
    anchor = np.full(rows, ANCHOR_STIFFNESS)
    right, many = packets.build_right_hand_side(anchor), len(packets.packet_start) - 1
    near = allocate_aligned(
        (PACKET_SCRATCH_SIZE + SPRING_SCRATCH_SIZE * int(np.diff(packets.packet_start).max())) * LANES
    )
    descent, projection, value = np.zeros((2, 4 * rows)), np.zeros(4 * rows), np.zeros(1)
    models, changes = np.zeros((2, many, 9 * LANES))
    evaluate_packets(packets, network.weights, x, right, near, descent, projection, value, models, changes)
    lanes = packets.row_offset // 4
    by_row = np.zeros((2, rows, 9))
    for out, found in zip(by_row, (models, changes), strict=True):
        out[lanes] = found.reshape(-1, 9, LANES).transpose(0, 2, 1).reshape(-1, 9)
    moved = slice(0, FIXED_VERTEX)
    falls, pulls = (a.reshape(*a.shape[:-1], -1, 4)[..., moved, :3] for a in (descent, projection))
    return Evaluation(value[0], falls, pulls, by_row[0, moved], by_row[1, moved])


def without_edges(packets: SpringPackets) -> SpringPackets:
    """The packets with the springs alone, in the same places."""
    assert packets.edges is not None
    edges = packets.edges._replace(has_limits=False, has_dashpots=False)
    return packets._replace(edges=edges)


@pytest.mark.parametrize("has_zero_length", [False, True])
@pytest.mark.parametrize("kind", ["limits", "dashpots", "limits and dashpots"])
def test_packets_have_the_gradient_the_energy_and_the_projection_of_the_energies(kind, has_zero_length):
    network = build_network(kind, has_zero_length=has_zero_length)
    p = network.positions
    q = p + 0.3 * np.random.default_rng(1).normal(size=p.shape)
    q[FIXED_VERTEX] = p[FIXED_VERTEX]
    found, other = evaluate(network, p), evaluate(network, q)
    expected, projected, rise = (
        ANCHOR_STIFFNESS * p,
        np.zeros_like(p),
        0.5 * ANCHOR_STIFFNESS * float(np.sum(q[:-1] ** 2) - np.sum(p[:-1] ** 2)),
    )
    for energy in (network.springs, *network.energies):
        energy.add_gradient(p, expected)
        energy.add_projection(p, projected)
        rise += energy.value(q) - energy.value(p)
    size = np.abs(expected).max()
    for descent in found.descent:
        np.testing.assert_allclose(descent, -expected[:FIXED_VERTEX], rtol=0, atol=ROUNDOFF * size)
    np.testing.assert_allclose(found.projection, projected[:FIXED_VERTEX], rtol=0, atol=ROUNDOFF * size)
    assert other.value - found.value == pytest.approx(rise, abs=1e-12 * (abs(found.value) + abs(other.value)))


@pytest.mark.parametrize("kind", ["limits", "dashpots", "limits and dashpots"])
def test_vertex_models_have_the_gradients_and_blocks_of_the_energies(kind):
    network = build_network(kind)
    p = network.positions
    found, plain = evaluate(network, p), evaluate(network, p, without_edges(network.packets))
    gradient = np.zeros_like(p)
    blocks = np.zeros((NUM_VERTICES, 3, 3))
    for energy in network.energies:
        energy.add_gradient(p, gradient)
        whole = energy.hessian(p).toarray()
        n = len(whole) // 3
        blocks[:n] += whole.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    added = found.models - plain.models
    size = np.abs(found.models).max()
    np.testing.assert_allclose(added[:, :3], -gradient[:FIXED_VERTEX], rtol=0, atol=ROUNDOFF * size)
    expected = blocks[:FIXED_VERTEX][:, *np.triu_indices(3)]
    np.testing.assert_allclose(added[:, 3:], expected, rtol=0, atol=ROUNDOFF * size)


@pytest.mark.parametrize("kind", ["limits", "dashpots", "limits and dashpots"])
def test_the_energy_change_of_a_vertex_is_that_of_all_energies(kind):
    network = build_network(kind)
    p, found = network.positions, evaluate(network, network.positions)
    energies = (network.springs, *network.energies)
    finite = np.flatnonzero(np.isfinite(found.changes[:, 6]))
    assert len(finite) > NUM_VERTICES // 2
    for i in finite:
        q = p.copy()
        q[i] += found.changes[i, 3:6]
        rise = 0.5 * ANCHOR_STIFFNESS * float(q[i] @ q[i] - p[i] @ p[i]) + sum(
            e.value(q) - e.value(p) for e in energies
        )
        assert found.changes[i, 6] == pytest.approx(rise, abs=1e-12 * (abs(found.value) + 1.0))


def test_limits_may_change_from_step_to_step():
    network = build_network("limits and dashpots")
    limits, *others = network.energies
    assert isinstance(limits, StrainLimits)
    assert network.packets.edges is not None
    moved = replace(limits, min_length=0.5 * limits.min_length, max_length=0.7 * limits.max_length)
    edges = network.packets.edges.with_limits(moved.min_length, moved.max_length)
    found = evaluate(network, network.positions, network.packets._replace(edges=edges))
    expected = ANCHOR_STIFFNESS * network.positions
    for energy in (network.springs, moved, *others):
        energy.add_gradient(network.positions, expected)
    np.testing.assert_allclose(
        found.descent[0], -expected[:FIXED_VERTEX], rtol=0, atol=ROUNDOFF * np.abs(expected).max()
    )


def test_an_edge_of_a_vertex_with_itself_acts_on_nothing():
    network = build_network("limits")
    loop, one = np.array([[3, 3]]), np.ones(1)
    attached = AttachedEdges.from_energies(
        network.springs, (StrainLimits(loop, one, one, one, np.eye(3)[:1]),), (Dashpots(loop, one, np.eye(3)[:1], one),)
    )
    where = np.arange(NUM_VERTICES), np.zeros(NUM_VERTICES, np.int64), 1, NUM_VERTICES, NUM_VERTICES + 1
    packets, _ = SpringPackets.from_springs(network.springs, *where, attached)
    assert packets.edges is not None
    assert (packets.edges.limit_index == -1).all()
    assert (packets.edges.dashpot_index == 0).all()
