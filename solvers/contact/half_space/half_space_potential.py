"""Penalty contact of vertices with convex obstacles and Coulomb friction: one convex energy per step.

    E(x) = sum_i k_i/2 min(0, n_i.x_i - d_i)^2 + F_i h(|u_i|),   u_i = (I - n_i n_i')(x_i - a_i)

n_i, d_i: the half-space that contains the vertex during this step
(`springbench.solvers.contact.half_space.separating_planes`). a_i: position of the vertex if it moved with the obstacle.
F_i = mu k_i depth_i, with the depth at `start.normal_force_positions`, an iterate of this step, or at the step's start
if that is None (Li et al. 2020, "Incremental potential contact", section 5;
`springbench.solvers.contact.lagged_friction` iterates it to convergence). h is the length, smoothed where a vertex
moves by less than the smoothing length s = eps_v (t_x - t), with t_x the time of the stage
(`springbench.solvers.contact.potentials.friction_law`).

A sticking vertex moves at most at the speed `eps_v`. Half-spaces, depth and friction refer to the end of the step. If
the stage is the position at another time (`springbench.solvers.model.integrators`), all of these are moved towards the
start in proportion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.solvers.contact.contact_work import ObstacleWork
from springbench.solvers.contact.half_space import separating_planes as contact_planes
from springbench.solvers.contact.half_space.half_space_element import HALF_SPACE_LAW
from springbench.solvers.contact.half_space.separating_planes import RoundedBox, SeparatingPlanes
from springbench.solvers.contact.half_space.vertex_contact import PenaltyRows
from springbench.solvers.contact.lagged_friction import MAX_FRICTION_ITERATIONS
from springbench.solvers.contact.potentials.friction_law import evaluate_friction
from springbench.solvers.model.energies.element_energies import ElementLaw, Elements
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Positions, StepStart

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ConvexObstacle:
    """Rounded box: all points within a radius of a box in a moving frame.

    Attributes:
        low, high: corners (3,) of the box in its frame [m]; extents may be infinite.
        radius: radius [m].
        frame: time [s] -> frame (4, 3), its origin in row 0 and its orthonormal axes in the others; the same array at
            all times for a static obstacle.
    """

    low: FloatArray
    high: FloatArray
    radius: float
    frame: Callable[[float], FloatArray]

    def signed_distance(self, p: Positions, time: float) -> FloatArray:
        """Return the signed distances (n,) [m] of points (n, 3) from the surface, negative inside.

        Args:
            p: positions (n, 3) [m].
            time: time [s].
        """
        frame = self.frame(time)
        x = (p - frame[0]) @ frame[1:].T
        outside = np.linalg.norm(x - np.clip(x, self.low, self.high), axis=1)
        inside = np.minimum(self.high - x, x - self.low).min(axis=1)
        return np.where(outside > 0.0, outside, -inside) - self.radius


class ContactPlanes(NamedTuple):
    """Half-spaces of vertices.

    Attributes:
        vertices: (k,).
        normal: unit normals n (k, 3).
        offset: d [m], (k,).
        friction_anchor: a [m], (k, 3).
        stiffness: penalty stiffness [N/m], (k,).
        friction_limit: F [N], (k,).
    """

    vertices: NDArray[np.int64]
    normal: Positions
    offset: FloatArray
    friction_anchor: Positions
    stiffness: FloatArray
    friction_limit: FloatArray


_NO_VECTORS, _NO_VALUES = np.empty((0, 3)), np.empty(0)
_NO_PLANES = ContactPlanes(np.empty(0, np.int64), _NO_VECTORS, _NO_VALUES, _NO_VECTORS, _NO_VALUES, _NO_VALUES)


@dataclass(frozen=True, eq=False)
class HalfSpaceContact:
    """Contact of all vertices with obstacles.

    Attributes:
        obstacles: convex obstacles.
        min_distance: minimum distance from their surfaces [m].
        friction: friction coefficient mu.
        stiffness: penalty stiffness k [N/m], (n,).
        eps_v: speed below which a vertex sticks [m/s].
        safety_margin: maximum displacement by forces in one step, in addition to that by the velocity [m].
        time_step: dt [s].
        friction_iterations: maximum number of solves of a step, each with the normal forces of the previous one.
        active_planes: half-spaces of the current step.
        smoothing_length: s of the current step [m].
    """

    obstacles: tuple[ConvexObstacle, ...]
    min_distance: float
    friction: float
    stiffness: FloatArray
    eps_v: float
    safety_margin: float
    time_step: float
    friction_iterations: int = MAX_FRICTION_ITERATIONS
    active_planes: ContactPlanes = field(default=_NO_PLANES)
    smoothing_length: float = 0.0

    element_law: ClassVar[ElementLaw] = HALF_SPACE_LAW

    @cached_property
    def elements(self) -> Elements:
        """Half-spaces of the current step as elements; none before a step."""
        p, count = self.active_planes, len(self.active_planes.vertices)
        numbers = (
            p.normal,
            p.offset,
            p.friction_anchor,
            p.stiffness,
            p.friction_limit,
            np.full(count, self.smoothing_length),
        )
        return Elements(p.vertices[:, None], np.ones((count, 1)), np.column_stack(numbers))

    def has_no_active_collisions(self) -> bool:
        """Return whether no vertex can collide in this step."""
        return not len(self.active_planes.vertices)

    @cached_property
    def _activation_boxes(self) -> tuple[FloatArray, FloatArray]:
        """Corners of the activation region of each obstacle, in its frame, (o, 3) [m]."""
        reach = np.array([[one.radius + self.min_distance + self.safety_margin] for one in self.obstacles])
        return np.array([o.low for o in self.obstacles]) - reach, np.array([o.high for o in self.obstacles]) + reach

    def compute_frames(self, time: float) -> FloatArray:
        """Return the obstacles' frames at a step's start and end, (o, 2, 4, 3)."""
        return np.array([(one.frame(time), one.frame(time + self.time_step)) for one in self.obstacles])

    @cached_property
    def _static_frames(self) -> FloatArray | None:
        """Frames in all steps if no obstacle moves, else None."""
        rest = all(one.frame(0.0) is one.frame(1.0) for one in self.obstacles)
        return self.compute_frames(0.0) if rest else None

    def begin_step(self, start: StepStart) -> HalfSpaceContact:
        """Return the energy of a step.

        While no obstacle is near, a single box test finds that the energy is inactive.
        """
        p, v = (x if x.flags.carray else np.array(x, order="C") for x in (start.positions, start.velocity))
        frames = self.compute_frames(start.time) if self._static_frames is None else self._static_frames
        touched = np.empty(len(frames), np.bool_)
        travel = contact_planes.find_nearby_obstacles(p, v, self.time_step, frames, *self._activation_boxes, touched)
        if travel < 0.0:
            return self
        lasts = start.stage_time - start.time
        when, x = lasts / self.time_step, start.normal_force_positions
        found = [
            self._build_planes(p, v, self.obstacles[k], frames[k], travel, when, x) for k in np.flatnonzero(touched)
        ]
        planes = ContactPlanes(*(np.concatenate(part) for part in zip(*found, strict=True)))
        return replace(self, active_planes=planes, smoothing_length=self.eps_v * lasts)

    def _build_planes(
        self,
        p: Positions,
        v: Positions,
        obstacle: ConvexObstacle,
        frames: FloatArray,
        max_displacement: float,
        stage_fraction: float,
        normal_force_positions: Positions | None,
    ) -> ContactPlanes:
        """Build the half-spaces of one obstacle.

        stage_fraction: time of the stage within the step, 1 at its end; normal_force_positions: where friction's normal
        forces are evaluated (n, 3) [m], None for the step's start.
        """
        n, body = len(p), RoundedBox(obstacle.low, obstacle.high, obstacle.radius + self.min_distance)
        found = SeparatingPlanes(np.empty(n, np.int64), np.empty((n, 3)), np.empty(n), np.empty((n, 3)))
        k = contact_planes.build_separating_planes(
            p, v, self.time_step, frames, body, self.safety_margin + max_displacement, found, np.empty((5, 3))
        )
        vertices, normal, offset, carried = (
            found.vertices[:k],
            found.normal[:k],
            found.offset[:k],
            found.comoving_position[:k],
        )
        here, stiffness = p[vertices], self.stiffness[vertices]
        before = _row_dots(normal, here)
        depth, offset = (
            stage_fraction * (offset - _row_dots(normal, carried)),
            before + stage_fraction * (offset - before),
        )
        if normal_force_positions is not None:
            depth = offset - _row_dots(normal, normal_force_positions[vertices])
        friction_force = self.friction * stiffness * np.maximum(0.0, depth)
        return ContactPlanes(
            vertices, normal, offset, here + stage_fraction * (carried - here), stiffness, friction_force
        )

    def friction_gradient(self, p: Positions) -> Positions | None:
        """Return the gradient of friction alone [N], (n, 3); None without contact."""
        if self.has_no_active_collisions():
            return None
        out = np.zeros_like(p)
        self._add_friction_gradient(p, out)
        return out

    def friction_potential(self, p: Positions) -> float:
        """Return the part of friction in the energy [J] at p (n, 3)."""
        if self.has_no_active_collisions():
            return 0.0
        friction = self._evaluate_friction(p)
        return float(self.active_planes.friction_limit[friction.planes] @ friction.smoothed)

    def obstacle_work(self, p: Positions, start: Positions) -> ObstacleWork:
        """Return the work of the obstacles from the step's start to its stage.

        Each vertex is pushed by the point of the obstacle that it would move with.

        Args:
            p: positions (n, 3) [m] of the stage, whose forces act.
            start: positions (n, 3) [m] at the step's start.
        """
        if self.has_no_active_collisions() or self._static_frames is not None:
            return ObstacleWork()
        planes, friction = self.active_planes, self._evaluate_friction(p)
        moved = planes.friction_anchor - start[planes.vertices]
        pushed = planes.stiffness * np.minimum(0.0, self.compute_gaps(p)) * _row_dots(planes.normal, moved)
        dragged = friction.stiffness * _row_dots(friction.u, moved[friction.planes])
        return ObstacleWork(-float(pushed.sum()), -float(dragged.sum()))

    def compute_gaps(self, p: Positions) -> FloatArray:
        """Return the gaps n.x - d [m], (k,)."""
        return _row_dots(self.active_planes.normal, p[self.active_planes.vertices]) - self.active_planes.offset

    def _evaluate_friction(self, p: Positions) -> _FrictionState:
        frictional, planes = np.flatnonzero(self.active_planes.friction_limit), self.active_planes
        u, n = p[planes.vertices[frictional]] - planes.friction_anchor[frictional], planes.normal[frictional]
        u -= _row_dots(u, n)[:, None] * n
        length, smoothed, stiffness = np.sqrt(_row_dots(u, u)), np.empty(len(frictional)), np.empty(len(frictional))
        evaluate_friction(planes.friction_limit[frictional], length, self.smoothing_length, smoothed, stiffness)
        return _FrictionState(frictional, u, length, smoothed, stiffness)

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p (n, 3)."""
        if self.has_no_active_collisions():
            return 0.0
        friction = self._evaluate_friction(p)
        pressed = self.active_planes.stiffness @ np.minimum(0.0, self.compute_gaps(p)) ** 2
        return 0.5 * float(pressed) + float(self.active_planes.friction_limit[friction.planes] @ friction.smoothed)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient, with that of friction.

        Args:
            p: positions (n, 3) [m].
            out: gradient (n, 3) [N], updated.
        """
        if self.has_no_active_collisions():
            return
        planes, gap = self.active_planes, self.compute_gaps(p)
        np.add.at(out, planes.vertices, (planes.stiffness * np.minimum(0.0, gap))[:, None] * planes.normal)
        self._add_friction_gradient(p, out)

    def _add_friction_gradient(self, p: Positions, out: Positions) -> None:
        friction = self._evaluate_friction(p)
        np.add.at(out, self.active_planes.vertices[friction.planes], friction.stiffness[:, None] * friction.u)

    def add_absolute_terms(self, p: Positions, out: FloatArray) -> None:
        """Add the absolute values of the gradient's terms, for the rounding-error bound.

        These are k (|x| + |d|) of penalties that are active, or may be by round-off, and F/max(s, |u|) (|x| + |a|) of
        friction.

        Args:
            p: positions (n, 3) [m].
            out: sums (n,) [N], updated (`springbench.solvers.model.rounding_bound`).
        """
        if self.has_no_active_collisions():
            return
        planes, size = self.active_planes, np.sqrt(_row_dots(p, p))[self.active_planes.vertices]
        reach = size + np.abs(planes.offset)
        presses = self.compute_gaps(p) <= EPS * reach
        np.add.at(out, planes.vertices, np.where(presses, planes.stiffness * reach, 0.0))
        friction = self._evaluate_friction(p)
        anchor = planes.friction_anchor[friction.planes]
        terms = friction.stiffness * (size[friction.planes] + np.sqrt(_row_dots(anchor, anchor)))
        np.add.at(out, planes.vertices[friction.planes], terms)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], (3n, 3n), with blocks of vertices in contact."""
        rows, n = self.build_penalty_rows(p, p, majorise=False), len(p)
        blocks = np.zeros((n, 3, 3))
        np.add.at(blocks, rows.vertices, _outer_products(rows.stiffness, rows.direction))
        in_contact = np.zeros(n, bool)
        in_contact[rows.vertices] = True
        columns = np.flatnonzero(in_contact)
        indptr = np.concatenate([[0], np.cumsum(in_contact)])
        return scipy.sparse.csr_array(scipy.sparse.bsr_array((blocks[columns], columns, indptr), shape=(3 * n, 3 * n)))

    def build_penalty_rows(self, p: Positions, trial: Positions, *, majorise: bool) -> PenaltyRows:
        """Build the penalty rows of active contacts and of friction.

        Args:
            p: positions (n, 3) [m].
            trial: trial positions (n, 3) [m]; penalties active at p or there are included.
            majorise: whether friction majorises the energy; its stiffness is exact otherwise.
        """
        planes, gap = self.active_planes, self.compute_gaps(p)
        pressed = np.flatnonzero((gap < 0.0) | (self.compute_gaps(trial) < 0.0))
        frictional, u, length, _, weight = self._evaluate_friction(p)
        normal = planes.normal[frictional]
        sticks = length <= self.smoothing_length
        along = np.divide(u, length[:, None], out=_perpendicular_units(normal), where=~sticks[:, None])
        both = sticks | majorise
        return PenaltyRows(
            planes.vertices[np.concatenate([pressed, frictional, frictional[both]])],
            np.concatenate([planes.normal[pressed], np.cross(normal, along), along[both]]),
            np.concatenate([planes.stiffness[pressed], weight, weight[both]]),
            np.concatenate([np.maximum(0.0, gap[pressed]), np.zeros(len(frictional) + int(both.sum()))]),
        )


class _FrictionState(NamedTuple):
    """Friction at given positions.

    Attributes:
        planes: indices of the half-spaces with friction (q,).
        u, length: tangential displacement (q, 3) and its length (q,) [m].
        smoothed: h of the length (q,) [m].
        stiffness: force per displacement (q,) [N/m].
    """

    planes: NDArray[np.int64]
    u: Positions
    length: FloatArray
    smoothed: FloatArray
    stiffness: FloatArray


def _row_dots(a: Positions, b: Positions) -> FloatArray:
    return np.einsum("ij,ij->i", a, b)


def _outer_products(weight: FloatArray, direction: Positions) -> FloatArray:
    """Return w dd' of each row, (r, 3, 3)."""
    return weight[:, None, None] * direction[:, :, None] * direction[:, None, :]


def _perpendicular_units(normal: Positions) -> Positions:
    """Return a unit vector perpendicular to each normal, (k, 3)."""
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    across = np.cross(normal, least)
    return across / np.sqrt(_row_dots(across, across))[:, None]
