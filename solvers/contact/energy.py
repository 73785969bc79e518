"""Penalty contact of vertices with convex obstacles, and Coulomb friction, as one convex energy per step.

    E(x) = sum_i k_i/2 min(0, n_i.x_i - d_i)^2 + F_i h(|u_i|),   u_i = (I - n_i n_i')(x_i - a_i)

n_i, d_i: the half-space that contains the vertex during this step (`solvers.contact.planes`).
a_i: position of the vertex if it moved with the obstacle. F_i = mu k_i depth_i, with the depth at `start.pressed`, an
iterate of this step, or at the step's start if that is None (Li et al. 2020, "Incremental potential contact", section
5; `solvers.contact.friction_rounds` iterates it to convergence). h is the length, smoothed where a vertex moves by less
than s = creep (t_x - t), the smoothing length, with t_x the time of the stage:

    h(u) = u^2/(2 s) for u <= s,   u - s/2 beyond

A sticking vertex moves at most at the speed `creep`. Half-spaces, depth and friction refer to the end of the step. If
the stage is the position at another time (`solvers.integrators`), both are moved towards the start in proportion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from solvers.contact import planes as contact_planes
from solvers.contact.friction_rounds import ROUNDS
from solvers.contact.law import LAW
from solvers.contact.planes import HalfSpaces, Rounded
from solvers.contact.touching import ContactRows
from solvers.energies.elements import Elements, Law
from solvers.problem import Positions, Start
from solvers.round_off import EPS

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Obstacle:
    """Rounded box: all points within a radius of a box in a moving frame.

    Attributes:
        low, high: corners (3,) of the box in its frame [m]; extents may be infinite.
        radius: radius [m].
        frame: time [s] -> frame (4, 3), its origin in row 0 and its orthonormal axes in the others; the same array at
            all times for a static obstacle.
    """

    low: Array
    high: Array
    radius: float
    frame: Callable[[float], Array]

    def distance(self, p: Positions, time: float) -> Array:
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


class Planes(NamedTuple):
    """Half-spaces of vertices.

    Attributes:
        vertices: (k,).
        normal: unit normals n (k, 3).
        offset: d [m], (k,).
        anchor: a [m], (k, 3).
        stiffness: penalty stiffness [N/m], (k,).
        grip: F [N], (k,).
    """

    vertices: NDArray[np.int64]
    normal: Positions
    offset: Array
    anchor: Positions
    stiffness: Array
    grip: Array


_VECTORS, _NUMBERS = np.empty((0, 3)), np.empty(0)
_NONE = Planes(np.empty(0, np.int64), _VECTORS, _NUMBERS, _VECTORS, _NUMBERS, _NUMBERS)


@dataclass(frozen=True, eq=False)
class Contact:
    """Contact of all vertices with obstacles.

    Attributes:
        obstacles: convex obstacles.
        thickness: minimum distance from their surfaces [m].
        friction: friction coefficient mu.
        stiffness: penalty stiffness k [N/m], (n,).
        creep: speed below which a vertex sticks [m/s].
        margin: maximum displacement by forces in one step, in addition to that by the velocity [m].
        time_step: dt [s].
        friction_rounds: maximum number of solves of a step, each with the normal forces of the previous one.
        planes: half-spaces of the current step.
        slip: s of the current step [m].
    """

    obstacles: tuple[Obstacle, ...]
    thickness: float
    friction: float
    stiffness: Array
    creep: float
    margin: float
    time_step: float
    friction_rounds: int = ROUNDS
    planes: Planes = field(default=_NONE)
    slip: float = 0.0

    law: ClassVar[Law] = LAW

    @cached_property
    def elements(self) -> Elements:
        """Half-spaces of the current step as elements; none before a step."""
        p, count = self.planes, len(self.planes.vertices)
        numbers = p.normal, p.offset, p.anchor, p.stiffness, p.grip, np.full(count, self.slip)
        return Elements(p.vertices[:, None], np.ones((count, 1)), np.column_stack(numbers))

    def idle(self) -> bool:
        """Return whether no vertex can collide in this step."""
        return not len(self.planes.vertices)

    @cached_property
    def _near(self) -> tuple[Array, Array]:
        """Corners of the activation region of each obstacle, in its frame, (o, 3) [m]."""
        reach = np.array([[one.radius + self.thickness + self.margin] for one in self.obstacles])
        return np.array([o.low for o in self.obstacles]) - reach, np.array([o.high for o in self.obstacles]) + reach

    def frames(self, time: float) -> Array:
        """Return the obstacles' frames at a step's start and end, (o, 2, 4, 3)."""
        return np.array([(one.frame(time), one.frame(time + self.time_step)) for one in self.obstacles])

    @cached_property
    def _resting(self) -> Array | None:
        """Frames in all steps if no obstacle moves, else None."""
        rest = all(one.frame(0.0) is one.frame(1.0) for one in self.obstacles)
        return self.frames(0.0) if rest else None

    def begin_step(self, start: Start) -> Contact:
        """Return the energy of a step.

        While no obstacle is near, a single box test finds that the energy is inactive.
        """
        p, v = (x if x.flags.carray else np.array(x, order="C") for x in (start.positions, start.velocity))
        frames = self.frames(start.time) if self._resting is None else self._resting
        touched = np.empty(len(frames), np.bool_)
        way = contact_planes.near(p, v, self.time_step, frames, *self._near, touched)
        if way < 0.0:
            return self
        lasts = start.until - start.time
        when, x = lasts / self.time_step, start.pressed
        found = [self._planes(p, v, self.obstacles[k], frames[k], way, when, x) for k in np.flatnonzero(touched)]
        planes = Planes(*(np.concatenate(part) for part in zip(*found, strict=True)))
        return replace(self, planes=planes, slip=self.creep * lasts)

    def _planes(
        self,
        p: Positions,
        v: Positions,
        obstacle: Obstacle,
        frames: Array,
        way: float,
        when: float,
        pressed: Positions | None,
    ) -> Planes:
        """Build the half-spaces of one obstacle.

        when: time of the stage within the step, 1 at its end; pressed: where friction's normal
        forces are evaluated (n, 3) [m], None for the step's start.
        """
        n, body = len(p), Rounded(obstacle.low, obstacle.high, obstacle.radius + self.thickness)
        found = HalfSpaces(np.empty(n, np.int64), np.empty((n, 3)), np.empty(n), np.empty((n, 3)))
        k = contact_planes.planes(p, v, self.time_step, frames, body, self.margin + way, found, np.empty((5, 3)))
        vertices, normal, offset, carried = found.vertices[:k], found.normal[:k], found.offset[:k], found.carried[:k]
        here, stiffness = p[vertices], self.stiffness[vertices]
        before = _dots(normal, here)
        depth, offset = when * (offset - _dots(normal, carried)), before + when * (offset - before)
        if pressed is not None:
            depth = offset - _dots(normal, pressed[vertices])
        grip = self.friction * stiffness * np.maximum(0.0, depth)
        return Planes(vertices, normal, offset, here + when * (carried - here), stiffness, grip)

    def friction_gradient(self, p: Positions) -> Positions | None:
        """Return the gradient of friction alone [N], (n, 3); None without contact."""
        if self.idle():
            return None
        out = np.zeros_like(p)
        self._add_friction_gradient(p, out)
        return out

    def gap(self, p: Positions) -> Array:
        """Return the gaps n.x - d [m], (k,)."""
        return _dots(self.planes.normal, p[self.planes.vertices]) - self.planes.offset

    def _slipped(self, p: Positions) -> tuple[NDArray[np.int64], Positions, Array]:
        """Return the half-spaces with friction (q,), and u (q, 3) and |u| (q,) [m] there."""
        grips, planes = np.flatnonzero(self.planes.grip), self.planes
        u, n = p[planes.vertices[grips]] - planes.anchor[grips], planes.normal[grips]
        u -= _dots(u, n)[:, None] * n
        return grips, u, np.sqrt(_dots(u, u))

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p (n, 3)."""
        if self.idle():
            return 0.0
        grips, _, length = self._slipped(p)
        rounded = np.where(length <= self.slip, 0.5 * length**2 / self.slip, length - 0.5 * self.slip)
        pressed = self.planes.stiffness @ np.minimum(0.0, self.gap(p)) ** 2
        return 0.5 * float(pressed) + float(self.planes.grip[grips] @ rounded)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N] at p to `out`, (n, 3) each."""
        if self.idle():
            return
        planes, gap = self.planes, self.gap(p)
        np.add.at(out, planes.vertices, (planes.stiffness * np.minimum(0.0, gap))[:, None] * planes.normal)
        self._add_friction_gradient(p, out)

    def _add_friction_gradient(self, p: Positions, out: Positions) -> None:
        planes, (grips, u, length) = self.planes, self._slipped(p)
        np.add.at(out, planes.vertices[grips], (planes.grip[grips] / np.maximum(self.slip, length))[:, None] * u)

    def add_absolute_terms(self, p: Positions, out: Array) -> None:
        """Add the absolute values of the gradient's terms, for the rounding-error bound.

        These are k (|x| + |d|) of penalties that are active, or may be by round-off, and F/max(s, |u|) (|x| + |a|) of
        friction.

        Args:
            p: positions (n, 3) [m].
            out: sums (n,) [N], updated (`solvers.round_off`).
        """
        if self.idle():
            return
        planes, size = self.planes, np.sqrt(_dots(p, p))[self.planes.vertices]
        reach = size + np.abs(planes.offset)
        presses = self.gap(p) <= EPS * reach
        np.add.at(out, planes.vertices, np.where(presses, planes.stiffness * reach, 0.0))
        grips, _, length = self._slipped(p)
        anchor = planes.anchor[grips]
        friction = planes.grip[grips] / np.maximum(self.slip, length) * (size[grips] + np.sqrt(_dots(anchor, anchor)))
        np.add.at(out, planes.vertices[grips], friction)

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], (3n, 3n), with blocks of vertices in contact."""
        rows, n = self.rows(p, p, cautious=False), len(p)
        blocks = np.zeros((n, 3, 3))
        np.add.at(blocks, rows.vertices, _outer(rows.weight, rows.direction))
        held = np.zeros(n, bool)
        held[rows.vertices] = True
        columns = np.flatnonzero(held)
        indptr = np.concatenate([[0], np.cumsum(held)])
        return scipy.sparse.csr_array(scipy.sparse.bsr_array((blocks[columns], columns, indptr), shape=(3 * n, 3 * n)))

    def rows(self, p: Positions, trial: Positions, *, cautious: bool) -> ContactRows:
        """Build the penalty rows of active contacts and of friction.

        Args:
            p: positions (n, 3) [m].
            trial: trial positions (n, 3) [m]; penalties active at p or there are included.
            cautious: whether friction majorises the energy; its stiffness is exact otherwise.
        """
        planes, gap = self.planes, self.gap(p)
        pressed = np.flatnonzero((gap < 0.0) | (self.gap(trial) < 0.0))
        grips, u, length = self._slipped(p)
        normal, weight = planes.normal[grips], planes.grip[grips] / np.maximum(self.slip, length)
        sticks = length <= self.slip
        along = np.divide(u, length[:, None], out=_across(normal), where=~sticks[:, None])
        both = sticks | cautious
        return ContactRows(
            planes.vertices[np.concatenate([pressed, grips, grips[both]])],
            np.concatenate([planes.normal[pressed], np.cross(normal, along), along[both]]),
            np.concatenate([planes.stiffness[pressed], weight, weight[both]]),
            np.concatenate([np.maximum(0.0, gap[pressed]), np.zeros(len(grips) + int(both.sum()))]),
        )


def _dots(a: Positions, b: Positions) -> Array:
    return np.einsum("ij,ij->i", a, b)


def _outer(weight: Array, direction: Positions) -> Array:
    """Return w dd' of each row, (r, 3, 3)."""
    return weight[:, None, None] * direction[:, :, None] * direction[:, None, :]


def _across(normal: Positions) -> Positions:
    """Return a unit vector perpendicular to each normal, (k, 3)."""
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    across = np.cross(normal, least)
    return across / np.sqrt(_dots(across, across))[:, None]
