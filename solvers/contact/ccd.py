"""Additive continuous collision detection (CCD): the largest collision-free step size along a displacement.

    t <- t + .9 (d(t) - min_distance)/l,     l = upper bound of the speed at which the distance d of the pair shrinks

Source: Li, Kaufman and Jiang 2021, "Codimensional incremental potential contact", section 5. The first advance also
subtracts a tenth, and each later one a twentieth, of the initial gap from the distance. The common translation of a
pair is removed first, which gives a tighter bound l. Pairs that are farther apart than they can move are discarded in
8-lane packets. Each pair retains at least a twentieth of its initial gap, which is far more than round-off.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.geometry.aabb import componentwise_max, componentwise_min
from springbench.solvers.contact.geometry.distance import (
    compute_pair_distance,
    dot3,
    edge_edge_distance_vector,
    point_triangle_distance_vector,
    subtract3,
)
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel
from springbench.solvers.model.step_problem import Positions
from springbench.solvers.simd.float64x8 import (
    gather_rows,
    load_packet,
    lowest_set_bit,
    mask_to_bits,
    sqrt_packet,
    store_packet,
    where,
)

MIN_GAP_FRACTION = 0.1
"""Fraction of the initial gap at which the CCD of a pair stops; each step leaves at least half of it."""

_ROUNDOFF_FACTOR = 1.0 + 1e-12
"""Factor on displacements, so that round-off discards no pair."""

_MAX_CCD_ITERATIONS = 500
"""Maximum number of CCD iterations of one pair; if they do not suffice, the last iterate is used, which is safe."""


def allocate_ccd_scratch() -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Allocate the scratch arrays `local_indices`, `corners` and `relative_displacement` of the CCD."""
    return np.empty(4, np.int64), np.empty((4, 3)), np.empty((4, 3))


@jit_kernel
def collision_free_step_size(candidates, p, displacement, max_step, local_indices, corners, relative_displacement):
    """Return the largest step size at which all candidate pairs stay separated, on linear trajectories.

    Args:
        candidates: point-triangle pairs, then edge-edge pairs.
        p: positions (n, 4) [m]; column 3 is padding.
        displacement: displacements (n, 4) [m]; column 3 is padding.
        max_step: upper bound of the step size.
        local_indices, corners, relative_displacement: scratch, (4,), (4, 3) and (4, 3).

    Returns:
        Step size in [0, max_step]; 0 if a pair starts closer than its minimum distance.
    """
    for k in range(4):
        local_indices[k] = k
    end, edges = candidates.num_point_triangle, False
    for _ in range(2):
        begin, end = (end, len(candidates.vertices)) if edges else (0, end)
        for first in range(begin, end, 8):
            left = _needs_ccd(candidates, p, displacement, max_step, first, end - 1, edges)
            while left != 0:
                e = first + lowest_set_bit(left)
                left &= left - 1
                if e < end:
                    max_step = min(
                        max_step,
                        pair_collision_free_step_size(
                            candidates,
                            e,
                            p,
                            displacement,
                            max_step,
                            edges,
                            local_indices,
                            corners,
                            relative_displacement,
                        ),
                    )
            if max_step == 0.0:
                return 0.0
        edges = True
    return max_step


@jit_inner
def _needs_ccd(candidates, p, displacement, max_step, first, last, edges):
    """Return which of eight pairs require continuous collision detection, as a bit mask.

    The distances and displacement lengths of the other pairs exclude a collision for step sizes up to `max_step`.
    """
    x = candidates.vertices
    a, b, c, d = (
        gather_rows(p, x, first, last, 0),
        gather_rows(p, x, first, last, 1),
        gather_rows(p, x, first, last, 2),
        gather_rows(p, x, first, last, 3),
    )
    z = edge_edge_distance_vector(a, b, c, d)[4] if edges else point_triangle_distance_vector(a, b, c, d)[4]
    a, b, c, d = (
        gather_rows(displacement, x, first, last, 0),
        gather_rows(displacement, x, first, last, 1),
        gather_rows(displacement, x, first, last, 2),
        gather_rows(displacement, x, first, last, 3),
    )
    mean = _mean_coordinate(a, b, c, d, 0), _mean_coordinate(a, b, c, d, 1), _mean_coordinate(a, b, c, d, 2)
    l0, l1, l2, l3 = (
        _relative_length(a, mean),
        _relative_length(b, mean),
        _relative_length(c, mean),
        _relative_length(d, mean),
    )
    speed = _packet_max(l0, l1) + _packet_max(l2, l3) if edges else l0 + _packet_max(l1, _packet_max(l2, l3))
    return 255 & ~mask_to_bits(
        (sqrt_packet(dot3(z, z)) - candidates.min_distance) * (1.0 - MIN_GAP_FRACTION)
        >= _ROUNDOFF_FACTOR * max_step * speed
    )


@jit_inner
def _mean_coordinate(a, b, c, d, axis):
    return 0.25 * (a[axis] + b[axis] + c[axis] + d[axis])


@jit_inner
def _relative_length(a, mean):
    a = subtract3(a, mean)
    return sqrt_packet(dot3(a, a))


@jit_inner
def _packet_max(a, b):
    return where(a > b, a, b)


@jit_inner
def pair_collision_free_step_size(
    candidates, e, p, displacement, max_step, edges, local_indices, corners, relative_displacement
):
    """Return the largest step size in [0, max_step] at which one pair stays separated.

    It is a lower bound of the time of impact, with the distance that `MIN_GAP_FRACTION` demands.

    Args:
        candidates: the candidate pairs.
        e: index of the pair.
        p: positions (n, 4) [m].
        displacement: displacements (n, 4) [m].
        max_step: upper bound of the step size.
        edges: whether the pair is one of edges.
        local_indices, corners, relative_displacement: scratch, (4,), (4, 3) and (4, 3).
    """
    x = candidates.vertices[e]
    speed = _centre_motion(p, displacement, x, edges, corners, relative_displacement)
    closed = candidates.distance_scale[e] * candidates.min_distance
    gap = compute_pair_distance(p, x, edges) - closed
    if not gap > 0.0:
        return 0.0
    return (
        max_step
        if gap * (1.0 - MIN_GAP_FRACTION) >= max_step * speed
        else _additive_ccd(corners, relative_displacement, local_indices, edges, gap, closed, speed, max_step)
    )


@jit_inner
def _additive_ccd(corners, relative_displacement, local_indices, edges, gap, min_distance, speed, max_step):
    """Return the collision-free step size of one pair; `corners` are moved along."""
    least, t = MIN_GAP_FRACTION * gap, 0.9 * (1.0 - MIN_GAP_FRACTION) * gap / speed
    done = 0.0
    for _ in range(_MAX_CCD_ITERATIONS):
        if t >= max_step:
            return max_step
        for k in range(4):
            for a in range(3):
                corners[k, a] += (t - done) * relative_displacement[k, a]
        done = t
        gap = compute_pair_distance(corners, local_indices, edges) - min_distance
        if gap <= least:
            return t
        t += 0.9 * (gap - 0.5 * least) / speed
    return done


@jit_inner
def _centre_motion(p, displacement, x, edges, corners, relative_displacement):
    """Write centred corners and displacements (4, 3); return the closing speed.

    Corners are relative to the first one, displacements to their mean.
    """
    for a in range(3):
        mean = 0.25 * (displacement[x[0], a] + displacement[x[1], a] + displacement[x[2], a] + displacement[x[3], a])
        for k in range(4):
            corners[k, a] = p[x[k], a] - p[x[0], a]
            relative_displacement[k, a] = displacement[x[k], a] - mean
    l0, l1, l2, l3 = (
        _row_length(relative_displacement, 0),
        _row_length(relative_displacement, 1),
        _row_length(relative_displacement, 2),
        _row_length(relative_displacement, 3),
    )
    return max(l0, l1) + max(l2, l3) if edges else l0 + max(l1, l2, l3)


@jit_inner
def _row_length(relative_displacement, k):
    return np.sqrt(
        relative_displacement[k, 0] ** 2 + relative_displacement[k, 1] ** 2 + relative_displacement[k, 2] ** 2
    )


def max_relative_displacement(p: Positions, q: Positions) -> float:
    """Return the largest displacement of any two vertices relative to each other.

    Args:
        p: start positions, contiguous (n, 3) [m].
        q: end positions, contiguous (n, 3) [m].

    Returns:
        Upper bound [m]; infinite if a coordinate is not finite.
    """
    return _displacement_diagonal(p, q, np.empty((9, 8)))


@jit_kernel
def _displacement_diagonal(p, q, tile):
    """Return the diagonal [m] of the bounding box of all q - p; tile (9, 8): scratch."""
    whole = len(p) // 8
    tile[:3], tile[3:6], tile[6:] = np.inf, -np.inf, 0.0
    if whole > 0:
        # Three consecutive registers contain x y z x y z ... of eight vertices.
        x, y, z = (
            load_packet(q, 0) - load_packet(p, 0),
            load_packet(q, 8) - load_packet(p, 8),
            load_packet(q, 16) - load_packet(p, 16),
        )
        # 0 x is NaN unless x is finite; sums of it detect coordinates that comparisons would ignore.
        low, high, nothing = (x, y, z), (x, y, z), (0.0 * x, 0.0 * y, 0.0 * z)
        for k in range(24, 24 * whole, 24):
            x, y, z = (
                load_packet(q, k) - load_packet(p, k),
                load_packet(q, k + 8) - load_packet(p, k + 8),
                load_packet(q, k + 16) - load_packet(p, k + 16),
            )
            low, high = componentwise_min((x, y, z), low), componentwise_max((x, y, z), high)
            nothing = nothing[0] + 0.0 * x, nothing[1] + 0.0 * y, nothing[2] + 0.0 * z
        for k in range(3):
            store_packet(low[k], tile, 8 * k)
            store_packet(high[k], tile, 24 + 8 * k)
            store_packet(nothing[k], tile, 48 + 8 * k)
    square, known = 0.0, 0.0
    for axis in range(3):
        least, most = np.inf, -np.inf
        for k in range(axis, 24, 3):
            least, most = min(least, tile[k // 8, k % 8]), max(most, tile[3 + k // 8, k % 8])
            known += tile[6 + k // 8, k % 8]
        for i in range(8 * whole, len(p)):
            d = q[i, axis] - p[i, axis]
            least, most, known = min(least, d), max(most, d), known + 0.0 * d
        square += (most - least) ** 2 if most > least else 0.0
    return np.sqrt(square) if known == 0.0 else np.inf


@jit_kernel
def is_rigid_translation(x, p, max_step):
    """Return whether all vertices are translated equally, up to a tolerance.

    Args:
        x: start positions (n, 4) [m]; column 3 is padding.
        p: end positions (n, 3) [m].
        max_step: tolerance along each axis [m].
    """
    if len(p) == 0:
        return True
    a, b, c = p[0, 0] - x[0, 0], p[0, 1] - x[0, 1], p[0, 2] - x[0, 2]
    for i in range(len(p)):
        d, e, f = p[i, 0] - x[i, 0] - a, p[i, 1] - x[i, 1] - b, p[i, 2] - x[i, 2] - c
        if not (abs(d) <= max_step and abs(e) <= max_step and abs(f) <= max_step):
            return False
    return True
