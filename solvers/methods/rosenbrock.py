"""Rosenbrock methods: linearly implicit, with one factorisation per step, one solve per stage, no iteration.

For p' = v, M v' = F(p) - D v and s = 1/(gamma h), a stage (u, w) of positions and velocities solves

    (s^2 M + s D + K) u = F(P) - D V + M sum c/h w_j + (s M + D) r,    w = s u - r,    r = V + sum c/h u_j

with P = p + sum a u_j and V = v + sum a w_j. The velocities are eliminated, so the matrix is that of a step problem. It
is factorised at the start of the step. K is the exact Hessian of the energies there, as the order conditions require.
If the step is too long for compressed springs, it may have no Cholesky factor. Adaptive steps are then halved. Fixed
steps reduce the springs' negative lateral stiffness (`solvers.core.definite`); only ROS2
retains its order in that case.
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
"""Safety factor of the step size; bounds of its decrease and increase from one step to the next."""
_FLOOR, _MOST = 1e-9, 100_000
"""Shortest step, relative to a frame; maximum number of attempted steps in a frame."""


@dataclass(frozen=True)
class _Linear:
    """Base class of the Rosenbrock solvers.

    Args:
        refine: number of fixed steps in a frame, used if `error` is 0.
        error: error of each adaptive step, root mean square over the vertices, relative to the mean spring
            length. An error of velocity counts by the displacement that it causes in a frame.
    """

    refine: int = 1
    error: float = 0.0

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    name: ClassVar[str]
    table: ClassVar[Rosenbrock]

    def prepare(self, system: System) -> PreparedRosenbrock:
        """Prepare the method for a system.

        Raises:
            Unsupported: for integrators other than `own` and implicit Euler, for unpinned vertices without mass, and
                for energies that depend on the start of a step, except drag on vertices.
        """
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
    """ROS2: two stages, order 2 for any matrix; L-stable."""

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
    """ROS3P: three stages, order 3; A-stable."""

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
    """RODAS: six stages, order 4 with an error estimate of order 3; L-stable and stiffly accurate."""

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
    """Statistics of adaptive steps in a frame.

    Numbers of accepted and rejected steps, the last step size [s], and the reached time of the frame [s].
    """

    accepted: int
    rejected: int
    step: float
    reached: float


class _Moved(NamedTuple):
    """Positions and velocities (n, 3) after a step, and its error estimate for both."""

    positions: Positions
    velocity: Positions
    error: tuple[Positions, Positions]


@dataclass(frozen=True, eq=False)
class PreparedRosenbrock(Iterative):
    """A Rosenbrock method, prepared for a system.

    Attributes:
        objective: of the energies without drag.
        drag: coefficients d (n,) [N s/m].
        refine: number of fixed steps in a frame.
        tolerance: error of each adaptive step [m], 0 for fixed steps.
        factorisations: factorisations of an attempted step.
    """

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
        """Order of the error estimate."""
        return self.table.order

    @property
    def evaluations(self) -> int:
        """Number of solves in a step."""
        return len(self.table.a)

    def within(self, tolerance: float) -> PreparedRosenbrock:
        """Return a copy with adaptive steps of the given error tolerance [m]."""
        return replace(self, tolerance=tolerance)

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve whose only iteration is the whole frame."""
        return Whole(*self.step(problem)[:2])

    def step(self, problem: StepProblem, h: float | None = None) -> tuple[Positions, Positions, Told]:
        """Integrate one frame; exact pins move at constant velocity.

        Args:
            problem: the step problem.
            h: first step size [s] of an adaptive method, the frame by default.

        Returns:
            Positions and velocities (n, 3) at the end of the frame, and step statistics.

        Raises:
            RuntimeError: if no step size meets the error tolerance.
        """
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
    """Integration of one frame: its forces, and the motion of its pins."""

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
        """Return the motion at the start of the frame, with the velocity of the pins."""
        v = self._start.velocity.copy()
        v[self._held] = self._pace
        return self._start.positions.copy(), v

    def carried(self, p: Positions, part: float) -> Positions:
        """Return p with exactly pinned vertices moved to their targets at a fraction of the frame."""
        p[self._held] = self._to if part == 1.0 else self._from + part * (self._to - self._from)
        return p

    def size(self, made: _Moved) -> float:
        """Return the norm of a step's error estimate [m]."""
        parts = (made.error[0][self._free], self._frame * made.error[1][self._free])
        with np.errstate(over="ignore", invalid="ignore"):
            found = (sum(float((x**2).sum()) for x in parts) / max(1, 3 * len(self._free))) ** 0.5
        return found if np.isfinite(found) else np.inf

    @staticmethod
    def lost(time: float) -> _Moved:
        """Raise NotPositiveDefinite for a step at a time of the frame [s]."""
        raise NotPositiveDefinite(f"after {time:.6g} s of the frame the Hessian is not finite, or nothing balances it")

    def moved(self, p: Positions, v: Positions, h: float, *, exact: bool = True) -> _Moved | None:
        """Attempt one step.

        Args:
            p: positions (n, 3) [m].
            v: velocities (n, 3) [m/s].
            h: step size [s].
            exact: whether the exact Hessian is required.

        Returns:
            The motion after the step, None if the matrix has no factor.
        """
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
    """Return x + factor sum_j weights_j parts_j as a new array."""
    out = x.copy()
    for weight, part in zip(weights, parts, strict=False):
        if weight:
            out += factor * weight * part
    return out
