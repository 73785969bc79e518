"""Outside engines: programs of others that take the same network, and step it through their own public interface.

    positions, velocities, masses, springs (k, r), pins, load -> substeps of the engine's own -> positions, velocities

None minimises the step's objective: they are graded by their motion. As with other methods that divide the step by
themselves, the iterations are substeps: the k-th iterate is the whole step in k of them. Loads stay within a step, and
pins move evenly. What an engine cannot express it refuses by name; where it is not installed, it says how to have it.
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
"""Of the largest acceleration: what the division of weights by masses may round."""


class Package(NamedTuple):
    """What is installed: the module that is imported, the distribution that brings it, our extra that names it."""

    module: str
    distribution: str
    extra: str

    def load(self, engine: str) -> Any:
        """The module. Raises Unsupported with the command that installs it."""
        try:
            return import_module(self.module)
        except ImportError as error:
            raise Unsupported(
                f"{engine}: {self.distribution} cannot be imported ({error}); `.venv/bin/pip install -e "
                f"'.[{self.extra}]'` in the checkout installs it"
            ) from error

    @property
    def told(self) -> str:
        """Its name and version."""
        try:
            return f"{self.distribution} {version(self.distribution)}"
        except PackageNotFoundError:
            return self.distribution


class Lines(NamedTuple):
    """What acts along edges: ends (m, 2); stiffness k [N/m], rest_length r [m] and damping c [N s/m], each (m,)."""

    ends: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    damping: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Network:
    """A system as engines take it.

    mass (n,) [kg]; free (f,), the vertices that move, and pinned (q,), those that do not by themselves; lines: springs
    and dashpots that act on any that moves; drag (n,) [N s/m], of vertices; time_step [s].
    """

    mass: NDArray[np.float64]
    free: NDArray[np.int64]
    pinned: NDArray[np.int64]
    lines: Lines
    drag: NDArray[np.float64]
    time_step: float

    @classmethod
    def of(cls, system: System, engine: str, *, damps: bool) -> Network:
        """damps: whether the engine knows dashpots and drag on vertices. Raises Unsupported for other energies, other
        integrators than `own` and implicit Euler, and vertices without mass that are not pinned."""
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
        """The acceleration (3,) [m/s^2] that a force (n, 3) [N] gives to all that moves, as gravity does; None where
        they are not given the same."""
        found = force[self.free] / self.mass[self.free, None]
        one = np.median(found, axis=0) if len(found) else np.zeros(3)
        return one if np.allclose(found, one, rtol=0.0, atol=_SAME * max(1.0, float(np.abs(one).max()))) else None

    def arrays(self, problem: StepProblem) -> dict[str, NDArray[Any]]:
        """All of it with a step's start and load, by the names that scripts read."""
        start, lines = problem.start, self.lines._asdict()
        begun = {"positions": start.positions, "velocities": start.velocity, "force": problem.force}
        return {"mass": self.mass, "free": self.free, "pinned": self.pinned, "drag": self.drag, **lines, **begun}


def _joined(parts: list[Lines], unpinned: NDArray[np.bool_]) -> Lines:
    """Those that have two ends, of which one moves."""
    none = Lines(np.empty((0, 2), np.int64), np.empty(0), np.empty(0), np.empty(0))
    ends, *rest = (np.concatenate(arrays) for arrays in zip(none, *parts, strict=True))
    acts = (ends[:, 0] != ends[:, 1]) & unpinned[ends].any(axis=1) & ((rest[0] > 0.0) | (rest[2] > 0.0))
    return Lines(ends[acts], *(array[acts] for array in rest))


class Stepping(Protocol):
    """An engine that has the network."""

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Positions [m] and velocities [m/s], (n, 3), at the step's end, after so many substeps."""
        ...


@dataclass(frozen=True)
class Engine(ABC):
    """What engines share: a frozen dataclass of parameters each."""

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    name: ClassVar[str]
    package: ClassVar[Package]
    damps: ClassVar[bool] = False

    def prepare(self, system: System) -> PreparedEngine:
        """Raises Unsupported for what the engine cannot express, and where it is not installed."""
        network = Network.of(system, self.name, damps=self.damps)
        stepping, told = self.built(network, self.package.load(self.name))
        soft = int((~system.pins.exact).sum())
        taken = f"; {soft} pins by penalty taken as exact" if soft else ""
        return PreparedEngine(system, stepping, f"{self.package.told}, {told}{taken}")

    @abstractmethod
    def built(self, network: Network, library: Any) -> tuple[Stepping, str]:
        """The network in the engine, and what was chosen, in words. Raises Unsupported."""

    @abstractmethod
    def script(self, name: str, network: Network, problem: StepProblem, substeps: int, frames: int) -> dict[str, str]:
        """What repeats a motion from a step's start by the engine alone, files by name: `NAME.py`, and what else it
        reads besides `NAME.npz`, which holds `Network.arrays` and the positions at the end, `end`. Raises
        Unsupported."""


@dataclass(frozen=True, eq=False)
class PreparedEngine(Iterative):
    """stepping: the engine with the network."""

    residual_of: ClassVar[ResidualOf] = "none"

    system: System
    stepping: Stepping
    choice: str
    facts: dict[str, float] = field(default_factory=dict[str, float])

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """See Iterative; from where the step starts."""
        return Substeps(self.stepping.step, problem)


def evenly(begin: Positions, end: Positions, substeps: int) -> list[Positions] | None:
    """Where pins (q, 3) [m] are at the start of each substep; None where they are at rest."""
    if np.array_equal(begin, end):
        return None
    return [begin + k / substeps * (end - begin) for k in range(substeps)]
