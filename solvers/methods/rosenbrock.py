"""Rosenbrock methods: linearly implicit, one factorisation a step and one solve a stage, no iteration.

For p' = v, M v' = F(p) - D v and s = 1/(gamma h), a stage (u, w) of positions and velocities solves

    (s^2 M + s D + K) u = F(P) - D V + M sum c/h w_j + (s M + D) r,    w = s u - r,    r = V + sum c/h u_j

with P = p + sum a u_j and V = v + sum a w_j: the velocities are eliminated, so the matrix is that of a step problem,
and is factorised at the step's start. K is the exact Hessian of the energies there, which the orders need. A step that
is too long for compressed springs may leave it no Cholesky factor. Steps by an error are halved then; steps of one
length take away from the springs' negative lateral stiffness (`solvers.core.definite`), where ROS2 alone keeps its
order.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.core import vertex_terms
from solvers.core.bounds import is_bounded
from solvers.core.definite import factorised
from solvers.core.driver import Iterating, Iterative
from solvers.core.fixed_objective import Objective
from solvers.core.forces import Whole
from solvers.core.objective import StepObjective
from solvers.energies.quadratic import drag_of_vertices
from solvers.methods.rosenbrock_tables import RODAS, ROS2, ROS3P, Rosenbrock
from solvers.problem import (
    NotPositiveDefinite,
    Positions,
    ResidualOf,
    StepProblem,
    System,
    Unsupported,
    is_lagged,
)

_CAUTION, _FEWEST, _LARGEST = 0.9, 0.2, 6.0
"""Of the step that an error allows; what steps shrink and grow by at once, at most."""
_FLOOR, _MOST = 1e-9, 100_000
"""Of a frame, the shortest step; steps that may be tried in a frame."""


@dataclass(frozen=True)
class _Linear:
    """refine: steps of one length in a frame, where `error` is 0; error: of each step, root mean square over the
    vertices, in parts of the springs' mean length, an error of velocity counting by what it moves in a frame."""

    refine: int = 1
    error: float = 0.0

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    name: ClassVar[str]
    table: ClassVar[Rosenbrock]

    def prepare(self, system: System) -> PreparedRosenbrock:
        """Raises Unsupported for integrators other than `own` and implicit Euler, vertices without mass that are not
        pinned, and energies that depend on where a step starts, but for drag on vertices."""
        if self.refine < 1 or not 0.0 <= self.error <= 1.0:
            raise Unsupported(
                f"{self.name}: refine came as {self.refine} and error as {self.error}; wanted 1 or more, and a number "
                "from 0 to 1"
            )
        vertex_terms.require_implicit_euler(system, self.name)
        vertex_terms.require_mass(system, np.where(system.unpinned, system.mass, np.inf), self.name)
        drag, kept = np.zeros(system.vertices), list[Any]()
        for energy in system.energies:
            if (c := drag_of_vertices(energy)) is not None:
                drag += c
            elif is_lagged(energy) or is_bounded(energy):
                raise Unsupported(
                    f"{self.name}: needs the exact derivatives of all forces, and knows energies of the positions "
                    f"alone and drag on vertices; the scene has {type(energy).__name__} as well"
                )
            else:
                kept.append(energy)
        objective = Objective(replace(system, energies=tuple(kept), factor=0.0))
        lengths, factor = objective.springs.rest_length, objective.matrix.factor
        tolerance = self.error * (float(lengths.mean()) if len(lengths) else 1.0)
        told = f"steps by an error of {self.error:.3g}" if self.error else f"{self.refine} steps a frame"
        choice = f"{told}, a factor of the Hessian with {factor.nonzeros:,} entries{objective.interpreted}"
        facts = {"nnz_hessian_factor": float(factor.nonzeros)}
        return PreparedRosenbrock(system, self.table, objective, drag, self.refine, tolerance, choice, facts)


def _about(authors: str, year: int, title: str, doi: str) -> About:
    return About("linearly implicit", Reference(authors, year, title, doi), own_steps=True)


@dataclass(frozen=True)
class Ros2(_Linear):
    """Two stages of order 2, for any matrix; L-stable."""

    name: ClassVar[str] = "ros2"
    table: ClassVar[Rosenbrock] = ROS2
    about: ClassVar[About] = _about(
        "Verwer, Jan G. and Spee, Edwin J. and Blom, Joke G. and Hundsdorfer, Willem",
        1999,
        "A second-order Rosenbrock method applied to photochemical dispersion problems",
        "10.1137/S1064827597326651",
    )


@dataclass(frozen=True)
class Ros3P(_Linear):
    """Three stages of order 3; A-stable."""

    name: ClassVar[str] = "ros3p"
    table: ClassVar[Rosenbrock] = ROS3P
    about: ClassVar[About] = _about(
        "Lang, Jens and Verwer, Jan",
        2001,
        "ROS3P: an accurate third-order Rosenbrock solver designed for parabolic problems",
        "10.1023/A:1021900219772",
    )


@dataclass(frozen=True)
class Rodas(_Linear):
    """Six stages of order 4 with an error of order 3; L-stable, and ends in its last stage."""

    name: ClassVar[str] = "rodas"
    table: ClassVar[Rosenbrock] = RODAS
    about: ClassVar[About] = replace(
        _about(
            "Hairer, Ernst and Wanner, Gerhard",
            1996,
            "Solving Ordinary Differential Equations II",
            "10.1007/978-3-642-05221-7",
        ),
        to_error=True,
    )


class Told(NamedTuple):
    """Steps accepted and rejected, the last one's length [s], and the time of the frame that was reached [s]."""

    accepted: int
    rejected: int
    step: float
    reached: float


class _Moved(NamedTuple):
    """Positions and velocities (n, 3) after a step, and its error of both."""

    positions: Positions
    velocity: Positions
    error: tuple[Positions, Positions]


@dataclass(frozen=True, eq=False)
class PreparedRosenbrock(Iterative):
    """objective: of the energies alone; drag: d (n,) [N s/m]; refine: steps in a frame; tolerance [m]: of each where
    they differ, else 0; factorisations: of a step that is tried."""

    residual_of: ClassVar[ResidualOf] = "none"
    factorisations: ClassVar[int] = 1

    system: System
    table: Rosenbrock
    objective: Objective
    drag: NDArray[np.float64]
    refine: int
    tolerance: float
    choice: str
    facts: dict[str, float] = field(default_factory=dict[str, float])

    @property
    def order(self) -> int:
        """Of the error."""
        return self.table.order

    @property
    def evaluations(self) -> int:
        """Solves of a step."""
        return len(self.table.a)

    def within(self, tolerance: float) -> PreparedRosenbrock:
        """The same with steps by an error of each [m]."""
        return replace(self, tolerance=tolerance)

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """The whole frame."""
        return Whole(*self.step(problem)[:2])

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, Told]:
        """Positions and velocities (n, 3) at the frame's end, and what it took. h: the first step [s] of those that go
        by an error, the frame if left out. Exact pins move evenly in a frame. Raises RuntimeError where no step is
        short enough for the error."""
        frame = self.system.time_step
        within = _Frame(self, problem)
        p, v = within.begun()
        if not self.tolerance:
            for k in range(self.refine):
                p, v, _ = within.moved(p, v, frame / self.refine, exact=False) or within.lost(k * frame / self.refine)
            return within.carried(p, 1.0), v, Told(self.refine, 0, frame / self.refine, frame)
        t, accepted, rejected, h, before = 0.0, 0, 0, min(frame, h or frame), 1.0
        power = 1.0 + min(self.table.order, self.table.embedded)
        while t < frame:
            last = t + 1.0000001 * h >= frame
            length = frame - t if last else h
            made = within.moved(p, v, length)
            ratio = within.size(made) / self.tolerance if made else np.inf
            if ratio <= 1.0 and made:
                accepted, t = accepted + 1, frame if last else t + length
                p, v = within.carried(made.positions, t / frame), made.velocity
                change = _CAUTION * max(ratio, 1e-10) ** (-0.7 / power) * before ** (0.4 / power)
                before = max(ratio, 1e-4)
                h = max(h, length * change) if last else length * min(_LARGEST, max(_FEWEST, change))
            else:
                rejected += 1
                h = length * (max(_FEWEST, _CAUTION * ratio ** (-1.0 / power)) if ratio < np.inf else 0.5)
            if h < _FLOOR * frame or accepted + rejected >= _MOST:
                raise RuntimeError(
                    f"the error of {self.tolerance:.3g} m was not kept within {accepted + rejected} steps, the last of "
                    f"{h:.3g} s: after {t:.6g} of {frame:.6g} s of the frame the forces are too sudden, or round-off "
                    "is larger; ask for a larger error"
                )
        return p, v, Told(accepted, rejected, h, t)


class _Frame:
    """One frame: its forces, and where its pins are."""

    def __init__(self, prepared: PreparedRosenbrock, problem: StepProblem) -> None:
        self._of, self._start = prepared, problem.start
        system, pins = prepared.system, prepared.system.pins
        p, targets = problem.start.positions, problem.pin_targets
        inner = StepProblem(prepared.objective.system, p, problem.force, targets, p, p, problem.start)
        self._step = StepObjective(prepared.objective, inner)
        self._held, self._frame = pins.vertices[pins.exact], system.time_step
        self._from, self._to = p[self._held], targets[pins.exact]
        self._pace = (self._to - self._from) / self._frame
        self._moving = bool(self._pace.any())
        self._mass, self._drag = system.mass[:, None], prepared.drag[:, None]
        self._free = system.free

    def begun(self) -> tuple[Positions, Positions]:
        """The motion at the frame's start, pins as they move in it."""
        v = self._start.velocity.copy()
        v[self._held] = self._pace
        return self._start.positions.copy(), v

    def carried(self, p: Positions, part: float) -> Positions:
        """p with its exactly pinned vertices where they are after a part of the frame."""
        p[self._held] = self._to if part == 1.0 else self._from + part * (self._to - self._from)
        return p

    def size(self, made: _Moved) -> float:
        """The error of a step [m]."""
        parts = (made.error[0][self._free], self._frame * made.error[1][self._free])
        with np.errstate(over="ignore", invalid="ignore"):
            found = (sum(float((x**2).sum()) for x in parts) / max(1, 3 * len(self._free))) ** 0.5
        return found if np.isfinite(found) else np.inf

    @staticmethod
    def lost(time: float) -> _Moved:
        """Raise NotPositiveDefinite for a step at a time of the frame [s]."""
        raise NotPositiveDefinite(f"after {time:.6g} s of the frame the Hessian is not finite, or nothing balances it")

    def moved(self, p: Positions, v: Positions, h: float, *, exact: bool = True) -> _Moved | None:
        """A step of h [s] from positions p and velocities v; None where the matrix has no factor.
        exact: whether it must be the exact one."""
        table, step, m, d = self._of.table, self._step, self._mass, self._drag
        s = 1.0 / (table.gamma * h)
        hessian = step.hessian(p)
        inertia = np.repeat((s * s * m + s * d)[self._free, 0], 3)
        if not (hessian.factorise(1.0, inertia) if exact else factorised(hessian, inertia, inertia) is not None):
            return None
        us, ws = list[Positions](), list[Positions]()
        for a, c in zip(table.a, table.c, strict=True):
            at, speed = (_sum(x, a, parts) for x, parts in ((p, us), (v, ws)))
            r = _sum(speed, c, us, 1.0 / h)
            right = m * _sum(np.zeros_like(v), c, ws, 1.0 / h) + (s * m + d) * r - d * speed - step.gradient(at)
            u = np.zeros_like(p)
            if self._moving:
                u[self._held] = r[self._held] / s
                right -= hessian.multiply(u)
            u[self._free] = hessian.solve(right)[self._free]
            us.append(u)
            ws.append(s * u - r)
        zero = np.zeros_like(p)
        w = _sum(v, table.m, ws)
        w[self._held] = self._pace
        return _Moved(_sum(p, table.m, us), w, (_sum(zero, table.e, us), _sum(zero, table.e, ws)))


def _sum(x: Positions, weights: tuple[float, ...], parts: list[Positions], factor: float = 1.0) -> Positions:
    """x + factor sum_j weights_j parts_j, as an array of its own."""
    out = x.copy()
    for weight, part in zip(weights, parts, strict=False):
        if weight:
            out += factor * weight * part
    return out
