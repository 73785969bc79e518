"""The interfaces between a scene and a solver: Energy, System, StepProblem, Solver.

A step of implicit Euler minimises the incremental potential (Liu et al. 2013, eq. 6)

    g(p) = sum of energies(p) + c/(2 dt^2) |p - target|_M^2 - tr(p' f) + sum_pins w/2 |p_i - pin_i|^2

over the positions p that satisfy all length constraints, with c = 1 and target = 2 p^t - p^(t-dt). Other integrators
have other values of c and target (`springbench.solvers.model.integrators`). `StepProblem` evaluates g in plain
NumPy; every accuracy figure is computed from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, Literal, Protocol, TypeGuard, runtime_checkable

import numpy as np
import scipy
from numpy.typing import NDArray

Positions = NDArray[np.float64]
"""Positions [m], shape (n, 3), float64, C-contiguous."""
ResidualIterate = Literal["returned", "previous", "none"]
"""The iterate that a residual belongs to: the returned one, or its predecessor; "none" if there is no residual."""


@dataclass(frozen=True, slots=True, eq=False)
class DirichletPins:
    """Dirichlet conditions: `vertices` (q,), sorted and unique; `weight` (q,) [N/m], infinite for an exact pin.

    Example:
        >>> import numpy as np
        >>> springbench.DirichletPins(np.array([0, 3]), weight=np.array([np.inf, 1e6])).exact_mask.tolist()
        [True, False]
    """

    vertices: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    weight: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    @property
    def exact_mask(self) -> NDArray[np.bool_]:
        """Mask of the pins that are eliminated instead of penalised, shape (q,)."""
        return np.isinf(self.weight)


@dataclass(frozen=True, slots=True, eq=False)
class LengthConstraints:
    """Length constraints that are satisfied exactly, from springs and strain limits of infinite stiffness.

    Attributes:
        edges: (m, 2).
        min_length, max_length: bounds of the lengths (m,) [m], 0 <= low <= high, 0 < high; equal for an inextensible
            spring.
        rest_direction: (m, 3), unit directions of edges of zero length.

    Example:
        >>> import numpy as np
        >>> edges, length, direction = np.array([[0, 1]]), np.array([2.0]), np.array([[1.0, 0.0, 0.0]])
        >>> springbench.LengthConstraints(edges, length, length, direction).max_length.tolist()
        [2.0]
    """

    edges: NDArray[np.int64]
    min_length: NDArray[np.float64]
    max_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]


class PluginContractError(Exception):
    """An error in a user-supplied solver component; the message begins with the source line."""


class Unsupported(Exception):
    """An error for a system that a solver cannot minimise.

    The message states the unsupported part of the system and the reason.

    Example:
        >>> str(springbench.Unsupported("mine: supports springs only; the scene has Bending"))
        'mine: supports springs only; the scene has Bending'
    """


class NotPositiveDefinite(Exception):
    """An error for a system matrix without a Cholesky factor.

    Causes are a vertex without mass, spring or pin, rounding errors, and invalid input.

    Attributes:
        vertices: the vertices that the message names.

    Example:
        >>> springbench.NotPositiveDefinite("vertex 3 has no mass, spring or pin", vertices=[3]).vertices
        (3,)
    """

    def __init__(self, message: str = "", vertices: Sequence[int] = ()) -> None:
        super().__init__(message)
        self.vertices = tuple(vertices)


class Energy(Protocol):
    """A potential energy [J] as a function of the positions [m].

    Example:
        >>> import numpy as np
        >>> from scipy.sparse import csr_array
        >>> class Weight:
        ...     def value(self, p):
        ...         return 9.81 * float(p[:, 1].sum())
        ...     def add_gradient(self, p, out):
        ...         out[:, 1] += 9.81
        ...     def hessian(self, p):
        ...         return csr_array((p.size, p.size))
        >>> gradient = np.zeros((1, 3))
        >>> Weight().add_gradient(np.ones((1, 3)), gradient)
        >>> gradient.tolist()
        [[0.0, 9.81, 0.0]]
    """

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p, shape (n, 3)."""
        ...

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient to `out`.

        Args:
            p: positions (n, 3) [m].
            out: the sum of gradients (n, 3) [N].
        """
        ...

    def hessian(self, p: Positions) -> scipy.sparse.csr_array:
        """Return the Hessian [N/m], shape (3n, 3n), with the coordinates of a vertex contiguous."""
        ...


@runtime_checkable
class ProjectiveEnergy(Energy, Protocol):
    """A projective energy (Bouaziz et al. 2014).

    It is min over d of sum_e w_e/2 |(A p)_e - d_e|^2, with each d_e on a manifold.

    Example:
        >>> import numpy as np
        >>> from scipy.sparse import eye_array
        >>> class Tethers:  # w/2 |p_i|^2 of each vertex: d is zero
        ...     def value(self, p):
        ...         return 50.0 * float((p * p).sum())
        ...     def add_gradient(self, p, out):
        ...         out += 100.0 * p
        ...     def hessian(self, p):
        ...         return 100.0 * eye_array(p.size, format="csr")
        ...     def stiffness_matrix(self, n):
        ...         return 100.0 * eye_array(n, format="csr")
        ...     def add_projection(self, p, out):
        ...         return
        >>> isinstance(Tethers(), springbench.ProjectiveEnergy)
        True
    """

    def stiffness_matrix(self, n: int) -> scipy.sparse.csr_array:
        """Return the contribution A'KA [N/m] of the energy to the system matrix, shape (n, n)."""
        ...

    def add_projection(self, p: Positions, out: Positions) -> None:
        """Add the contribution A'K d(p) to the right-hand side.

        Args:
            p: positions (n, 3) [m], from which d is found.
            out: the right-hand side (n, 3) [N].
        """
        ...


@dataclass(frozen=True, eq=False)
class System:
    """The data that stay constant in a run, so that they are factorised once.

    Attributes:
        mass: (n,) [kg]; zero is allowed at vertices with a spring or a pin.
        time_step: dt [s].
        energies: potentials of the positions.
        pins: the pinned vertices and their weights.
        inertia_factor: the integrator's c.
        velocity_factor: the integrator's ratio of the velocity to the change of the stage, in units of 1/dt; None for
            sqrt(c).
        length_constraints: length constraints that are satisfied exactly.

    Example:
        >>> import numpy as np
        >>> springbench.System(mass=np.array([2.0, 2.0]), time_step=0.5).inertia_diagonal.tolist()
        [8.0, 8.0]
    """

    mass: NDArray[np.float64]
    time_step: float
    energies: tuple[Energy, ...] = ()
    pins: DirichletPins = field(default_factory=DirichletPins)
    inertia_factor: float = 1.0
    velocity_factor: float | None = None
    length_constraints: tuple[LengthConstraints, ...] = ()

    @property
    def velocity_rate(self) -> float:
        """Velocity per displacement of the stage, sqrt(c)/dt or velocity_factor/dt [1/s]."""
        return (self.inertia_factor**0.5 if self.velocity_factor is None else self.velocity_factor) / self.time_step

    @cached_property
    def inertia_diagonal(self) -> NDArray[np.float64]:
        """Diagonal c m/dt^2 (n,) [N/m] of the inertia term in the system matrix Q."""
        return self.inertia_factor * self.mass / self.time_step**2

    @property
    def num_vertices(self) -> int:
        """Number of vertices n."""
        return len(self.mass)

    @cached_property
    def free_vertices(self) -> NDArray[np.int64]:
        """Vertices that are degrees of freedom, i.e. all except the exactly pinned ones, shape (f,)."""
        return np.setdiff1d(np.arange(self.num_vertices), self.exact_pins[1])

    @cached_property
    def unpinned_mask(self) -> NDArray[np.bool_]:
        """Mask of the vertices without any pin, exact or by penalty, shape (n,)."""
        mask = np.ones(self.num_vertices, bool)
        mask[self.pins.vertices] = False
        return mask

    @cached_property
    def exact_pins(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Exact pins: their indices within `pins` (x,), and their vertices (x,)."""
        indices = np.flatnonzero(self.pins.exact_mask)
        return indices, self.pins.vertices[indices]

    @cached_property
    def penalty_pins(self) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.float64]]:
        """Penalty pins: their mask within `pins` (q,), their vertices and their weights [N/m]."""
        soft = ~self.pins.exact_mask
        return soft, self.pins.vertices[soft], self.pins.weight[soft]


@dataclass(frozen=True, slots=True, eq=False)
class StepStart:
    """The state at the start of a step, for lagged energies and non-minimising methods.

    Attributes:
        positions: p^t (n, 3) [m].
        velocity: v^t (n, 3) [m/s], after the velocity filters.
        time: t [s].
        velocity_origin: (n, 3) [m]; the stage x has the velocity velocity_rate * (x - velocity_origin).
        velocity_rate: velocity per displacement [1/s].
        stage_time: time of the stage x [s]; the default nan propagates into all results that depend on it.
        lag_extrapolation: time [s] by which lagged positions are extrapolated.
        lag_override: positions (n, 3) [m] that replace p^t as the lagged ones.
        predicted_acceleration: acceleration (n, 3) [m/s^2] predicted from the previous motion.
        warm_start: warm start from the previous solve.
        normal_force_positions: an iterate of x (n, 3) [m] at which friction evaluates normal forces; None for the start
            of the step.
        pattern_positions: an iterate of x (n, 3) [m] near which the Hessian's pattern is determined; None for the start
            of the solve.

    Example:
        >>> import numpy as np
        >>> p, v = np.zeros((1, 3)), np.ones((1, 3))
        >>> start = springbench.StepStart(p, v, time=0.0, velocity_origin=p, velocity_rate=2.0)
        >>> start.velocity_at(p + 1.0).tolist()
        [[2.0, 2.0, 2.0]]
    """

    positions: Positions
    velocity: Positions
    time: float
    velocity_origin: Positions
    velocity_rate: float
    stage_time: float = float("nan")
    lag_extrapolation: float = 0.0
    lag_override: Positions | None = None
    predicted_acceleration: Positions | None = None
    warm_start: NDArray[np.float64] | None = None
    normal_force_positions: Positions | None = None
    pattern_positions: Positions | None = None

    @property
    def lagged_positions(self) -> Positions:
        """Positions (n, 3) [m] of lagged energies: p^t or `lag_override`, extrapolated by `lag_extrapolation`."""
        p = self.positions if self.lag_override is None else self.lag_override
        return p + self.lag_extrapolation * self.velocity if self.lag_extrapolation else p

    def velocity_at(self, x: Positions) -> Positions:
        """Return the velocity [m/s] of the stage x, both (n, 3)."""
        return self.velocity_rate * (x - self.velocity_origin)


class LaggedEnergy(Energy, Protocol):
    """An energy that depends on the start of the step.

    Examples are damping, friction and moving obstacles. The stiffness of a projective energy may depend on the
    `velocity_rate` of the start only, because Q is built once.

    Example:
        >>> class Drag:  # |p - p^t|^2/2
        ...     def __init__(self, origin=None):
        ...         self.origin = origin
        ...     def begin_step(self, start):
        ...         return Drag(start.positions)
        ...     def value(self, p):
        ...         return 0.5 * float(((p - self.origin) ** 2).sum())

        >>> import numpy as np
        >>> p = np.zeros((1, 3))
        >>> start = springbench.StepStart(p, p, time=0.0, velocity_origin=p, velocity_rate=2.0)
        >>> Drag().begin_step(start).value(p + 1.0)
        1.5
    """

    def begin_step(self, start: StepStart) -> Energy:
        """Return the energy of this step."""
        ...


def is_lagged(energy: Energy) -> TypeGuard[LaggedEnergy]:
    """Return whether an energy is lagged.

    `isinstance` on the protocol would take a hundredth of the time of a small step.
    """
    return hasattr(energy, "begin_step")


@dataclass(frozen=True, eq=False)
class StepProblem:
    """The objective of one step. All arrays are float64 and never modified.

    Attributes:
        system: the data that stay constant in a run.
        inertial_target: positions of the stage under inertia alone (n, 3) [m], velocity filters included.
        external_force: external force (n, 3) [N].
        pin_targets: target positions of the pins (q, 3) [m], in the order of `system.pins`.
        current_positions: p^t with pinned vertices on their targets (n, 3) [m]; the stop rule takes the initial
            residual here.
        initial_guess: initial guess of the iteration (n, 3) [m].
        step_start: state at the start of the step.

    Example:
        >>> import numpy as np
        >>> system, p = springbench.System(np.array([1.0]), time_step=0.5), np.zeros((1, 3))
        >>> start = springbench.StepStart(p, 0.0 * p, 0.0, p, system.velocity_rate)
        >>> weight = np.array([[0.0, -8.0, 0.0]])
        >>> problem = springbench.StepProblem(system, p, weight, np.empty((0, 3)), p, p, start)

        >>> problem.gradient(p).tolist()
        [[0.0, 8.0, 0.0]]
        >>> problem.value(np.array([[0.0, -2.0, 0.0]]))  # the minimum: 4 N/m * 2 m is the weight
        -8.0
    """

    system: System
    inertial_target: Positions
    external_force: Positions
    pin_targets: Positions
    current_positions: Positions
    initial_guess: Positions
    step_start: StepStart

    @cached_property
    def energies(self) -> tuple[Energy, ...]:
        """Energies of the system in their order, with the lagged ones evaluated for this step."""
        return tuple(e.begin_step(self.step_start) if is_lagged(e) else e for e in self.system.energies)

    def evaluate_terms(self, p: Positions) -> dict[str, float]:
        """Return the terms [J] of the objective at p by name.

        The terms are inertia, force, pins, and the energies by the names of their classes in lower case.
        """
        s, values, away = self.system, dict[str, float](), p - self.inertial_target
        for energy in self.energies:
            name = type(energy).__name__.lower()  # a class may have the name of one of the terms below
            name = f"energy {name}" if name in ("inertia", "force", "pins") else name
            values[name] = values.get(name, 0.0) + energy.value(p)
        values["inertia"] = 0.5 * float(s.inertia_diagonal @ np.einsum("ij,ij->i", away, away))
        values["force"] = -float(np.einsum("ij,ij->", p, self.external_force))
        soft, vertices, weight = s.penalty_pins
        sag = p[vertices] - self.pin_targets[soft]
        values["pins"] = 0.5 * float(weight @ np.einsum("ij,ij->i", sag, sag))
        return values

    def value(self, p: Positions) -> float:
        """Return the objective g(p) [J]; exactly pinned vertices must be on their targets."""
        return sum(self.evaluate_terms(p).values())

    def value_scale(self, p: Positions) -> float:
        """Return the sum of absolute terms [J], the scale of rounding errors in `value`."""
        return sum(abs(term) for term in self.evaluate_terms(p).values())

    def gradient(self, p: Positions) -> Positions:
        """Return the gradient of g at p [N], shape (n, 3), with zero rows at exactly pinned vertices."""
        s = self.system
        out = s.inertia_diagonal[:, None] * (p - self.inertial_target) - self.external_force
        for energy in self.energies:
            energy.add_gradient(p, out)
        soft, vertices, weight = s.penalty_pins
        out[vertices] += weight[:, None] * (p[vertices] - self.pin_targets[soft])
        out[s.pins.vertices[s.pins.exact_mask]] = 0.0
        return out


@dataclass(frozen=True, slots=True)
class StopRule:
    """The criteria that terminate a solve.

    A solve ends after `max_iterations`, or if the residual is at most max(atol, rtol * initial residual), or if the
    gradient is no larger than rounding errors, so that a scene at rest stops immediately. The residual is
    |Q^-1 grad g(p)|_Q = |p - LG(p)|_Q over the unpinned vertices. The initial residual is the one at the current
    positions.

    Attributes:
        max_iterations: maximum number of iterations.
        rtol: relative tolerance; None for none.
        roundoff_floor: a gradient is round-off if at each unpinned vertex it is at most this factor times the bound of
            `springbench.solvers.model.rounding_bound`; 0 disables the criterion.
        atol: absolute tolerance [J^(1/2)].

    Example:
        >>> springbench.StopRule(max_iterations=200, rtol=1e-6)
        StopRule(max_iterations=200, rtol=1e-06, roundoff_floor=8.0, atol=0.0)
    """

    max_iterations: int = 50
    rtol: float | None = None
    roundoff_floor: float = 8.0
    atol: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The result of a solve.

    Attributes:
        positions: (n, 3) [m].
        num_iterations: number of iterations.
        residual: residual that the stop rule tested, |Q^-1 grad g|_Q [J^(1/2)] over the unpinned vertices, at the
            iterate that `residual_iterate` names; nan for a method that does not minimise.
        initial_residual: residual at the current positions; nan without a tolerance.
        termination_reason: "max-iter", "converged", "roundoff", "stalled" if no step decreases the objective, or
            "saddle" at a saddle point that the solve cannot leave.
        velocity: (n, 3) [m/s], for a method that computes its own.
        residual_iterate: the iterate of the residual.
        warm_start: warm start of the next solve, of any shape.
        solver_phases: iterations, counted cost and time [s] of each method that a solve switched between, by the order
            of use, with the times of `springbench.solvers.iteration.phase_clock`; None for a solver of one method.

    Example:
        >>> scene = springbench.load_scene("configs/scenes/chain.yaml")
        >>> simulation = springbench.Simulation(scene, "sparse", size=3)
        >>> positions = simulation.step()
        >>> simulation.last_step.solution.positions.shape
        (3, 3)
    """

    positions: Positions
    num_iterations: int
    residual: float
    initial_residual: float
    termination_reason: str
    velocity: Positions | None = None
    residual_iterate: ResidualIterate = "returned"
    warm_start: NDArray[np.float64] | None = None
    solver_phases: Mapping[str, tuple[int, float, float]] | None = None


class PreparedSolver(Protocol):
    """A solver after the setup for one system: factorisation, colouring and compilation.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Damped(springbench.FixedPointSolver):
        ...     share: float = 0.5
        ...     def next_iterate(self, p, before, correction):
        ...         return p - self.share * correction

        >>> import numpy as np
        >>> system, p = springbench.System(np.array([1.0]), time_step=0.5), np.zeros((1, 3))
        >>> start = springbench.StepStart(p, 0.0 * p, 0.0, p, system.velocity_rate)
        >>> weight = np.array([[0.0, -8.0, 0.0]])
        >>> problem = springbench.StepProblem(system, p, weight, np.empty((0, 3)), p, p, start)

        >>> prepared = Damped(1.0).prepare(system)
        >>> prepared.solve(problem, springbench.StopRule(2)).positions.tolist()
        [[0.0, -2.0, 0.0]]
    """

    @property
    def description(self) -> str:
        """Automatic decisions of the solver and their reasons in words; empty if there were none."""
        ...

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the setup by name, for example `nnz_system` and `nnz_factor`."""
        ...

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """Yield one iterate after another.

        A yielded array may be overwritten and must be copied to be stored.
        """
        ...

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Compute the iterates on the fast path.

        Args:
            problem: the step; its arrays are not modified.
            stop: the criteria that terminate the iteration.

        Returns:
            The iterate that `iterates` yields at the same count, with counts and residuals.
        """
        ...

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the residual |Q^-1 grad g|_Q [J^(1/2)] over the unpinned vertices.

        It is nan if it is not defined. The evaluation may cost an iteration.

        Args:
            problem: the step.
            p: positions (n, 3) [m].
        """
        ...

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the phases of an iteration by name, if any.

        The phases are callables that return what they compute.
        """
        ...


class Solver(Protocol):
    """The parameters of a method, as a frozen dataclass.

    A method that supports exact length constraints also has `supports_length_constraints = True`.

    Attributes:
        is_minimiser: whether the iterates converge to a minimum of the step's objective; other methods are scored by
            their trajectories.
        is_monotone: whether the objective increases in no iteration, except by round-off.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass(frozen=True)
        ... class Damped(springbench.FixedPointSolver):
        ...     share: float = 0.5
        ...     def next_iterate(self, p, before, correction):
        ...         return p - self.share * correction

        >>> scene = springbench.load_scene("configs/scenes/chain.yaml")
        >>> springbench.Simulation(scene, Damped(), size=3).step().shape
        (3, 3)
    """

    is_minimiser: ClassVar[bool]
    is_monotone: ClassVar[bool]

    def prepare(self, system: System) -> PreparedSolver:
        """Return the solver set up for a system.

        Raises:
            Unsupported: the method does not support part of the system; raised before any work.
            NotPositiveDefinite: the system matrix has no Cholesky factor.
        """
        ...
