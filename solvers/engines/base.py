"""External engines: third-party programs that step the same network through their own public interface.

    positions, velocities, masses, springs (k, r), pins, load -> substeps of the engine's own -> positions, velocities

None minimises the objective of the step: they are evaluated by their motion. As with other substepping methods, the
iterations are substeps: the k-th iterate is the whole step in k of them. Loads are constant within a step, and pins
move at constant velocity. A feature that an engine does not support raises an error with its name; if the engine is not
installed, the error has the installation command.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from solvers.core import vertex_terms
from solvers.core.driver import Iterating, Iterative, Substeps
from solvers.energies.dashpots import Dashpots
from solvers.energies.quadratic import drag_of_vertices
from solvers.energies.springs import Springs
from solvers.problem import Positions, ResidualOf, StepProblem, System, Unsupported

_SAME = 1e-12
"""Tolerance relative to the largest acceleration: the round-off of weights divided by masses."""


class Package(NamedTuple):
    """The package of an engine: imported module, distribution, and our extra that installs it."""

    module: str
    distribution: str
    extra: str

    def load(self, engine: str) -> Any:
        """Import the module; raise Unsupported with the installation command on failure."""
        try:
            return import_module(self.module)
        except ImportError as error:
            raise Unsupported(
                f"{engine}: {self.distribution} cannot be imported ({error}); `.venv/bin/pip install -e "
                f"'.[{self.extra}]'` in the checkout installs it"
            ) from error

    @property
    def told(self) -> str:
        """Return the name and version."""
        try:
            return f"{self.distribution} {version(self.distribution)}"
        except PackageNotFoundError:
            return self.distribution


class Lines(NamedTuple):
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
class Network:
    """A system in the form that engines support.

    Attributes:
        mass: (n,) [kg].
        free: (f,), the vertices that move.
        pinned: (q,), the vertices with prescribed motion.
        lines: springs and dashpots with at least one free end.
        drag: (n,) [N s/m].
        time_step: [s].
    """

    mass: NDArray[np.float64]
    free: NDArray[np.int64]
    pinned: NDArray[np.int64]
    lines: Lines
    drag: NDArray[np.float64]
    time_step: float

    @classmethod
    def of(cls, system: System, engine: str, *, damps: bool) -> Network:
        """Build the network of a system.

        Args:
            system: the system.
            engine: name of the engine, for messages.
            damps: whether the engine supports dashpots and drag on vertices.

        Raises:
            Unsupported: for other energies, integrators other than `own` and implicit Euler, and unpinned vertices
                without mass.
        """
        vertex_terms.require_implicit_euler(system, engine)
        vertex_terms.require_mass(system, np.where(system.unpinned, system.mass, np.inf), engine)
        lines, drag, others = list[Lines](), np.zeros(system.vertices), set[str]()
        for energy in system.energies:
            if isinstance(energy, Springs):
                k = energy.stiffness
                lines.append(Lines(energy.edges, k, energy.rest_length, 0.0 * k))
            elif damps and isinstance(energy, Dashpots):
                c = energy.stiffness
                lines.append(Lines(energy.edges, 0.0 * c, 0.0 * c, c))
            elif damps and (of_vertices := drag_of_vertices(energy)) is not None:
                drag += of_vertices
            else:
                others.add(type(energy).__name__)
        if others:
            known = "springs, dashpots and drag on vertices" if damps else "springs"
            raise Unsupported(f"{engine}: expresses {known}; the scene has {', '.join(sorted(others))} as well")
        free = np.flatnonzero(system.unpinned)
        return cls(system.mass, free, system.pins.vertices, _joined(lines, system.unpinned), drag, system.time_step)

    def acceleration(self, force: Positions) -> NDArray[np.float64] | None:
        """Return the common acceleration (3,) [m/s^2] of all free vertices under a force (n, 3) [N].

        Gravity is such a force. Return None if the accelerations differ.
        """
        found = force[self.free] / self.mass[self.free, None]
        one = np.median(found, axis=0) if len(found) else np.zeros(3)
        return one if np.allclose(found, one, rtol=0.0, atol=_SAME * max(1.0, float(np.abs(one).max()))) else None

    def arrays(self, problem: StepProblem) -> dict[str, NDArray[Any]]:
        """Return all arrays with a step's start and load, by the names that scripts read."""
        start, lines = problem.start, self.lines._asdict()
        begun = {"positions": start.positions, "velocities": start.velocity, "force": problem.force}
        return {"mass": self.mass, "free": self.free, "pinned": self.pinned, "drag": self.drag, **lines, **begun}


def _joined(parts: list[Lines], unpinned: NDArray[np.bool_]) -> Lines:
    """Concatenate edges with two distinct ends, at least one of them free."""
    none = Lines(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.empty(0))
    ends, *rest = (np.concatenate(arrays) for arrays in zip(none, *parts, strict=True))
    acts = (ends[:, 0] != ends[:, 1]) & unpinned[ends].any(axis=1) & ((rest[0] > 0.0) | (rest[2] > 0.0))
    return Lines(ends[acts], *(array[acts] for array in rest))


class Stepping(Protocol):
    """Interface of an engine with a loaded network."""

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate a step in `substeps` substeps; return positions [m] and velocities [m/s], (n, 3), at its end."""
        ...


@dataclass(frozen=True)
class Engine(ABC):
    """Base class of the engines; each is a frozen dataclass of parameters."""

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    name: ClassVar[str]
    package: ClassVar[Package]
    damps: ClassVar[bool] = False

    def prepare(self, system: System) -> PreparedEngine:
        """Prepare the engine for a system.

        Raises:
            Unsupported: for features that the engine does not support, and if it is not installed.
        """
        network = Network.of(system, self.name, damps=self.damps)
        stepping, told = self.built(network, self.package.load(self.name))
        soft = int((~system.pins.exact).sum())
        taken = f"; {soft} pins by penalty taken as exact" if soft else ""
        return PreparedEngine(system, stepping, f"{self.package.told}, {told}{taken}")

    @abstractmethod
    def built(self, network: Network, library: Any) -> tuple[Stepping, str]:
        """Build the network in the engine; return its stepper and a description, or raise Unsupported."""

    @abstractmethod
    def script(self, name: str, network: Network, problem: StepProblem, substeps: int, frames: int) -> dict[str, str]:
        """Return scripts that repeat a motion from a step's start with the engine only.

        Args:
            name: NAME of the files.
            network: the network.
            problem: the step problem with the start.
            substeps: substeps per frame.
            frames: number of frames.

        Returns:
            Files by name: `NAME.py`, and the files that it reads except `NAME.npz`. The latter contains
            `Network.arrays` and the final positions, `end`.

        Raises:
            Unsupported: for features that the script cannot express.
        """


@dataclass(frozen=True, eq=False)
class PreparedEngine(Iterative):
    """An engine, prepared for a system; `stepping` has the network."""

    residual_of: ClassVar[ResidualOf] = "none"

    system: System
    stepping: Stepping
    choice: str
    facts: dict[str, float] = field(default_factory=dict[str, float])

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve at the start of the step."""
        return Substeps(self.stepping.step, problem)


def evenly(begin: Positions, end: Positions, substeps: int) -> list[Positions] | None:
    """Interpolate the pins (q, 3) [m] linearly.

    Args:
        begin: at the start of the step.
        end: at its end.
        substeps: number of substeps.

    Returns:
        The pins at the start of each substep, None if they are at rest.
    """
    if np.array_equal(begin, end):
        return None
    return [begin + k / substeps * (end - begin) for k in range(substeps)]
