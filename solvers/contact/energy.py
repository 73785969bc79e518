"""Contact of vertices with convex obstacles, and Coulomb friction, as one convex energy a step.

    E(x) = sum_i k_i/2 min(0, n_i.x_i - d_i)^2 + F_i h(|u_i|),   u_i = (I - n_i n_i')(x_i - a_i)

n_i, d_i: the half-space that keeps the vertex out during this step (see `solvers.contact.planes`). a_i: where
the vertex would be had it moved with the obstacle. F_i = mu k_i depth_i, with the depth at `Start.pressed`, an iterate
of this step, or where that is None at the step's start (Li et al. 2020, "Incremental potential contact", section 5;
`solvers.contact.friction_rounds` iterates it to convergence). h is the length, rounded where a vertex moves by less
than `slip` = creep (t_x - t), with t_x the time of the unknown:

    h(u) = u^2/(2 slip) for u <= slip,   u - slip/2 beyond

What sticks moves at most at the speed `creep`. Half-spaces, depth and friction refer to the end of the step: where the
unknown is another time's position (see `solvers.integrators`), both are drawn nearer to the start in proportion.
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
    """All points within a radius [m] of the box from low to high (3,) [m] of a frame: its origin in the first row and
    its three orthonormal axes in the others, (4, 3), at a time [s]: the same array at all times where it does not move.
    Extents may be infinite."""

    low: Array
    high: Array
    radius: float
    frame: Callable[[float], Array]

    def distance(self, p: Positions, time: float) -> Array:
        """The distances (n,) [m] of points (n, 3) from its surface, negative inside."""
        frame = self.frame(time)
        x = (p - frame[0]) @ frame[1:].T
        outside = np.linalg.norm(x - np.clip(x, self.low, self.high), axis=1)
        inside = np.minimum(self.high - x, x - self.low).min(axis=1)
        return np.where(outside > 0.0, outside, -inside) - self.radius


class Planes(NamedTuple):
    """Half-spaces of vertices (k,): normal n (k, 3), offset d (k,) [m], anchor a (k, 3) [m], stiffness (k,) [N/m], and
    grip F (k,) [N]."""

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
    """Contact of all vertices with obstacles, at a thickness [m] from their surfaces.

    friction: mu; stiffness: k (n,) [N/m]; creep: speed below which a vertex sticks [m/s]; margin [m]: how far forces
    may bring a vertex in one step beyond where its velocity does; time_step: dt [s]; friction_rounds: solves of a step
    at most, each with the normal forces of the one before; planes, slip [m]: of a step that has begun.
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
        """The half-spaces of a step that has begun; none before."""
        p, count = self.planes, len(self.planes.vertices)
        numbers = p.normal, p.offset, p.anchor, p.stiffness, p.grip, np.full(count, self.slip)
        return Elements(p.vertices[:, None], np.ones((count, 1)), np.column_stack(numbers))

    def idle(self) -> bool:
        """Whether nothing can be touched in this step."""
        return not len(self.planes.vertices)

    @cached_property
    def _near(self) -> tuple[Array, Array]:
        """The corners of what is near each obstacle, in its frame, (o, 3) [m]."""
        reach = np.array([[one.radius + self.thickness + self.margin] for one in self.obstacles])
        return np.array([o.low for o in self.obstacles]) - reach, np.array([o.high for o in self.obstacles]) + reach

    def frames(self, time: float) -> Array:
        """The obstacles' frames at a step's start and end, (o, 2, 4, 3)."""
        return np.array([(one.frame(time), one.frame(time + self.time_step)) for one in self.obstacles])

    @cached_property
    def _resting(self) -> Array | None:
        """Their frames in all steps where none moves."""
        rest = all(one.frame(0.0) is one.frame(1.0) for one in self.obstacles)
        return self.frames(0.0) if rest else None

    def begin_step(self, start: Start) -> Contact:
        """The energy of a step; idle after one test of a box while nothing is near."""
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
        """The half-spaces of one obstacle; when: the unknown's time within the step, 1 at its end; pressed: where
        friction's normal forces are taken (n, 3) [m], None for the step's start."""
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
        """The gradient of friction alone [N], shape (n, 3); None where nothing is in contact."""
        if self.idle():
            return None
        out = np.zeros_like(p)
        self._add_friction_gradient(p, out)
        return out

    def gap(self, p: Positions) -> Array:
        """n.x - d (k,) [m]."""
        return _dots(self.planes.normal, p[self.planes.vertices]) - self.planes.offset

    def _slipped(self, p: Positions) -> tuple[NDArray[np.int64], Positions, Array]:
        """Which half-spaces have friction (q,), u (q, 3) and |u| (q,) [m] there."""
        grips, planes = np.flatnonzero(self.planes.grip), self.planes
        u, n = p[planes.vertices[grips]] - planes.anchor[grips], planes.normal[grips]
        u -= _dots(u, n)[:, None] * n
        return grips, u, np.sqrt(_dots(u, u))

    def value(self, p: Positions) -> float:
        """The energy [J] at p, shape (n, 3)."""
        if self.idle():
            return 0.0
        grips, _, length = self._slipped(p)
        rounded = np.where(length <= self.slip, 0.5 * length**2 / self.slip, length - 0.5 * self.slip)
        pressed = self.planes.stiffness @ np.minimum(0.0, self.gap(p)) ** 2
        return 0.5 * float(pressed) + float(self.planes.grip[grips] @ rounded)

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient [N], shape (n, 3), to `out`."""
        if self.idle():
            return
        planes, gap = self.planes, self.gap(p)
        np.add.at(out, planes.vertices, (planes.stiffness * np.minimum(0.0, gap))[:, None] * planes.normal)
        self._add_friction_gradient(p, out)

    def _add_friction_gradient(self, p: Positions, out: Positions) -> None:
        planes, (grips, u, length) = self.planes, self._slipped(p)
        np.add.at(out, planes.vertices[grips], (planes.grip[grips] / np.maximum(self.slip, length))[:, None] * u)

    def add_absolute_terms(self, p: Positions, out: Array) -> None:
        """Add k (|x| + |d|) [N] of what presses, or may by round-off, and F/max(slip, |u|) (|x| + |a|) of friction to
        `out` (n,) (`solvers.round_off`)."""
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
        """The Hessian [N/m], shape (3n, 3n): blocks of vertices that press or grip."""
        rows, n = self.rows(p, p, cautious=False), len(p)
        blocks = np.zeros((n, 3, 3))
        np.add.at(blocks, rows.vertices, _outer(rows.weight, rows.direction))
        held = np.zeros(n, bool)
        held[rows.vertices] = True
        columns = np.flatnonzero(held)
        indptr = np.concatenate([[0], np.cumsum(held)])
        return scipy.sparse.csr_array(scipy.sparse.bsr_array((blocks[columns], columns, indptr), shape=(3 * n, 3 * n)))

    def rows(self, p: Positions, trial: Positions, *, cautious: bool) -> ContactRows:
        """The stiffnesses at p (n, 3) of what presses there or at the trial position, and of friction.

        Those of friction are exact, and majorise the energy where `cautious`.
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
    """w dd' of each row, (r, 3, 3)."""
    return weight[:, None, None] * direction[:, :, None] * direction[:, None, :]


def _across(normal: Positions) -> Positions:
    """A unit vector across each normal, (k, 3)."""
    least = np.eye(3)[np.abs(normal).argmin(axis=1)]
    across = np.cross(normal, least)
    return across / np.sqrt(_dots(across, across))[:, None]
