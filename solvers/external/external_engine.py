"""External engines: third-party programs that step the same network through their own public interface.

    positions, velocities, masses, springs (k, r), pins, load -> the engine's substeps -> positions, velocities

No engine minimises the objective of the step: engines are evaluated by their motion. As with other substepping methods,
the iterations are substeps: the k-th iterate is the whole step in k substeps. Loads are constant within a step, and
pins move at constant velocity. A feature that an engine does not support raises an error with its name; if the engine
is not installed, the error contains the installation command.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState, SubsteppingState
from springbench.solvers.model.energies.dashpot_energy import Dashpots
from springbench.solvers.model.energies.quadratic_energy import drag_of_vertices
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, ResidualIterate, StepProblem, System, Unsupported

_ACCELERATION_RTOL = 1e-12
"""Tolerance relative to the largest acceleration: the round-off of weights divided by masses."""


class EnginePackage(NamedTuple):
    """The Python package of an external engine.

    Attributes:
        module_name: the module that is imported.
        distribution_name: the distribution that contains it.
        extra_name: the extra of springbench that installs it.
    """

    module_name: str
    distribution_name: str
    extra_name: str

    def import_library(self, engine: str) -> Any:
        """Import the module; raise Unsupported with the installation command on failure."""
        try:
            return import_module(self.module_name)
        except ImportError as error:
            raise Unsupported(
                f"{engine}: {self.distribution_name} cannot be imported ({error}); `.venv/bin/pip install -e "
                f"'.[{self.extra_name}]'` in the checkout installs it"
            ) from error

    @property
    def name_and_version(self) -> str:
        """The distribution's name and version; only the name if it is not installed."""
        try:
            return f"{self.distribution_name} {version(self.distribution_name)}"
        except PackageNotFoundError:
            return self.distribution_name


class SpringDashpots(NamedTuple):
    """Forces along edges.

    Attributes:
        ends: (m, 2).
        stiffness: k (m,) [N/m].
        rest_length: r (m,) [m].
        damping: c (m,) [N s/m].
    """

    ends: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    damping: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class EngineNetwork:
    """A system in the form that engines support.

    Attributes:
        mass: (n,) [kg].
        free_vertices: (f,), the vertices that move.
        pinned_vertices: (q,), the vertices with prescribed motion.
        spring_dashpots: springs and dashpots with at least one free end.
        vertex_drag: (n,) [N s/m].
        time_step: [s].
    """

    mass: NDArray[np.float64]
    free_vertices: NDArray[np.int64]
    pinned_vertices: NDArray[np.int64]
    spring_dashpots: SpringDashpots
    vertex_drag: NDArray[np.float64]
    time_step: float

    @classmethod
    def from_system(cls, system: System, engine: str, *, supports_damping: bool) -> EngineNetwork:
        """Build the network of a system.

        Args:
            system: the system.
            engine: name of the engine, for messages.
            supports_damping: whether the engine supports dashpots and drag on vertices.

        Raises:
            Unsupported: for other energies, integrators other than `substepping` and implicit Euler, and unpinned
                vertices without mass.
        """
        vertex_terms.require_implicit_euler(system, engine)
        vertex_terms.require_mass(system, np.where(system.unpinned_mask, system.mass, np.inf), engine)
        lines, drag, others = list[SpringDashpots](), np.zeros(system.num_vertices), set[str]()
        for energy in system.energies:
            if isinstance(energy, Springs):
                k = energy.stiffness
                lines.append(SpringDashpots(energy.edges, k, energy.rest_length, 0.0 * k))
            elif supports_damping and isinstance(energy, Dashpots):
                c = energy.stiffness
                lines.append(SpringDashpots(energy.edges, 0.0 * c, 0.0 * c, c))
            elif supports_damping and (of_vertices := drag_of_vertices(energy)) is not None:
                drag += of_vertices
            else:
                others.add(type(energy).__name__)
        if others:
            known = "springs, dashpots and drag on vertices" if supports_damping else "springs"
            raise Unsupported(f"{engine}: expresses {known}; the scene has {', '.join(sorted(others))} as well")
        free = np.flatnonzero(system.unpinned_mask)
        return cls(
            system.mass,
            free,
            system.pins.vertices,
            _concatenate_edges(lines, system.unpinned_mask),
            drag,
            system.time_step,
        )

    def uniform_acceleration(self, force: Positions) -> NDArray[np.float64] | None:
        """Return the common acceleration (3,) [m/s^2] of all free vertices under a force (n, 3) [N].

        Gravity is such a force. Return None if the accelerations differ.
        """
        found = force[self.free_vertices] / self.mass[self.free_vertices, None]
        one = np.median(found, axis=0) if len(found) else np.zeros(3)
        return (
            one
            if np.allclose(found, one, rtol=0.0, atol=_ACCELERATION_RTOL * max(1.0, float(np.abs(one).max())))
            else None
        )

    def export_arrays(self, problem: StepProblem) -> dict[str, NDArray[Any]]:
        """Return all arrays with a step's start and load, by the names that scripts read."""
        start, lines = problem.step_start, self.spring_dashpots._asdict()
        begun = {"positions": start.positions, "velocities": start.velocity, "force": problem.external_force}
        return {
            "mass": self.mass,
            "free": self.free_vertices,
            "pinned": self.pinned_vertices,
            "drag": self.vertex_drag,
            **lines,
            **begun,
        }


def _concatenate_edges(parts: list[SpringDashpots], unpinned: NDArray[np.bool_]) -> SpringDashpots:
    """Concatenate the edges that can exert a force on an unpinned vertex.

    These have distinct ends, at least one of them unpinned, and a stiffness or a damping.
    """
    none = SpringDashpots(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.empty(0))
    ends, *rest = (np.concatenate(arrays) for arrays in zip(none, *parts, strict=True))
    acts = (ends[:, 0] != ends[:, 1]) & unpinned[ends].any(axis=1) & ((rest[0] > 0.0) | (rest[2] > 0.0))
    return SpringDashpots(ends[acts], *(array[acts] for array in rest))


class ScriptFrames(NamedTuple):
    """Frames that a script repeats.

    Attributes:
        num_frames: number of frames.
        num_substeps: substeps of a frame.
        velocity_factor: factor of all velocities before each frame but the first.
        has_moving_pins: whether pins move.
    """

    num_frames: int
    num_substeps: int
    velocity_factor: float = 1.0
    has_moving_pins: bool = False

    @property
    def is_driven(self) -> bool:
        """Whether the engine's state is changed between substeps or frames."""
        return self.has_moving_pins or self.velocity_factor != 1.0

    def format_loop(self, plain: str, driven: str) -> str:
        """Format the loop of a script: plain, or with changes between frames.

        Args:
            plain: template of a loop with `steps` or `frames`.
            driven: template with `frames`, `substeps` and `factor`.
        """
        if not self.is_driven:
            return plain.format(steps=self.num_frames * self.num_substeps, frames=self.num_frames)
        return driven.format(frames=self.num_frames, substeps=self.num_substeps, factor=self.velocity_factor)


class EngineStepper(Protocol):
    """Interface of an engine with a loaded network."""

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate a step in equal substeps.

        Args:
            problem: the step; its start, external force and pin targets are used, and its initial guess is not.
            substeps: number of substeps.

        Returns:
            Positions [m] and velocities [m/s] at the end of the step, (n, 3) each.
        """
        ...


@dataclass(frozen=True)
class ExternalEngine(ABC):
    """Base class of the engines; each is a frozen dataclass of parameters."""

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_name: ClassVar[str]
    engine_package: ClassVar[EnginePackage]
    supports_damping: ClassVar[bool] = False

    def prepare(self, system: System) -> PreparedEngine:
        """Prepare the engine for a system.

        Raises:
            Unsupported: for features that the engine does not support, and if it is not installed.
        """
        network = EngineNetwork.from_system(system, self.solver_name, supports_damping=self.supports_damping)
        stepping, description = self.build_stepper(network, self.engine_package.import_library(self.solver_name))
        soft = int((~system.pins.exact_mask).sum())
        taken = f"; {soft} pins by penalty taken as exact" if soft else ""
        return PreparedEngine(system, stepping, f"{self.engine_package.name_and_version}, {description}{taken}")

    @abstractmethod
    def build_stepper(self, network: EngineNetwork, library: Any) -> tuple[EngineStepper, str]:
        """Build the network in the engine.

        Args:
            network: masses, springs, dashpots, drag and pins in the form that engines support.
            library: the imported module of the engine.

        Returns:
            The stepper, and a description of how it computes.

        Raises:
            Unsupported: for parameters or features that the engine does not support.
        """

    @abstractmethod
    def write_script(
        self, file_stem: str, network: EngineNetwork, problem: StepProblem, frames: ScriptFrames
    ) -> dict[str, str]:
        """Return scripts that repeat a motion from a step's start with the engine only.

        Args:
            file_stem: NAME of the files.
            network: the network.
            problem: the step problem with the start.
            frames: frames and their substeps.

        Returns:
            Files by name: `NAME.py`, and the files that it reads except `NAME.npz`. The latter contains
            `EngineNetwork.export_arrays`, the final positions, `end`, and for driven frames the targets of pins at
            their starts and at the end, `pins` (frames + 1, q, 3).

        Raises:
            Unsupported: for features that the script cannot express.
        """


@dataclass(frozen=True, eq=False)
class PreparedEngine(IterativeSolver):
    """An engine, prepared for a system; `engine_stepper` contains the network."""

    residual_iterate: ClassVar[ResidualIterate] = "none"
    has_inner_solves: ClassVar[bool] = True

    system: System
    engine_stepper: EngineStepper
    description: str
    stats: dict[str, float] = field(default_factory=dict[str, float])

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve at the start of the step.

        Args:
            problem: the step.
            initial_guess: not used, because each iterate integrates the whole step from its start.
        """
        return SubsteppingState(self.engine_stepper.step, problem)


def interpolate_pins(start_targets: Positions, end_targets: Positions, substeps: int) -> list[Positions] | None:
    """Interpolate the pins (q, 3) [m] linearly.

    Args:
        start_targets: at the start of the step.
        end_targets: at its end.
        substeps: number of substeps.

    Returns:
        The pins at the start of each substep, None if they are at rest.
    """
    if np.array_equal(start_targets, end_targets):
        return None
    return [start_targets + k / substeps * (end_targets - start_targets) for k in range(substeps)]
