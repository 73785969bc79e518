"""Extended position based dynamics: the springs as compliant constraints, one after another.

XPBD (Macklin, Mueller and Chentanez 2016) begins where the vertices would go without springs, and with no tension. In
each iteration it goes through all springs, and moves the two ends of each so that its tension t, which is added up over
the iterations, becomes k (|p_i - p_j| - r):

    dt = (k (|p_i - p_j| - r) - t) / (1 + k (1/held_i + 1/held_j)),    p_i -= dt/held_i n,    p_j += dt/held_j n

with n the spring's direction and held = c m/dt^2 + w, so that pins of any weight need no constraints of their own
(see `solvers.core.vertex_terms`); this is the paper's formula in forces, lambda = -t dt^2, and holds from k = 0 to the
largest. Small steps (Macklin et al. 2019) divides the time step instead, and does one iteration in each substep.

Neither minimises the step's objective. Tensions are added along directions that turn as the iteration goes on, and
the terms that would correct for that are left out: the fixed point is the minimiser where springs do not turn (a
straight chain), and near to it where they turn little in a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import count
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.core import colouring
from solvers.core import vertex_terms as blocks
from solvers.kernels import xpbd as kernels
from solvers.methods.local_global import only_springs
from solvers.problem import Positions, Solution, StepProblem, StopRule, System


@dataclass(frozen=True)
class Xpbd:
    """XPBD; the first guess is not used, nor is a tolerance."""

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    about: ClassVar[About] = About(
        "position-based",
        Reference(
            "Macklin, Miles and Müller, Matthias and Chentanez, Nuttapong",
            2016,
            "XPBD: position-based simulation of compliant constrained dynamics",
            "10.1145/2994258.2994272",
        ),
    )

    def prepare(self, system: System) -> PreparedXpbd:
        """Raises Unsupported for energies other than springs, and for vertices without mass that are not pinned."""
        held = blocks.held(system)
        constraints, choice = _prepared(system, held, "xpbd")
        return PreparedXpbd(system, constraints, *_eased(constraints, held), choice)


@dataclass(frozen=True)
class XpbdSmallSteps:
    """XPBD in small steps: as many substeps of one iteration as the stop rule has iterations. The k-th iterate is the
    whole step in k substeps; pins move evenly, and forces stay. The first guess is not used, nor is a tolerance."""

    minimises: ClassVar[bool] = False
    descends: ClassVar[bool] = False
    about: ClassVar[About] = About(
        "position-based",
        Reference(
            "Macklin, Miles and Storey, Kier and Lu, Michelle and Terdiman, Pierre and Chentanez, Nuttapong and "
            "Jeschke, Stefan and Müller, Matthias",
            2019,
            "Small steps in physics simulation",
            "10.1145/3309486.3340247",
        ),
        own_steps=True,
        first=True,
    )

    def prepare(self, system: System) -> PreparedSmallSteps:
        """Raises Unsupported as `Xpbd` does, and for integrators other than implicit Euler."""
        blocks.require_implicit_euler(system, "xpbd-small-steps")
        constraints, choice = _prepared(system, blocks.held(system), "xpbd-small-steps")
        return PreparedSmallSteps(system, constraints, choice)


@dataclass(frozen=True, eq=False)
class PreparedXpbd:
    """constraints: the springs by colour; compliance: 1/held (n,) [m/N]; ease (m,): see the kernels."""

    system: System
    constraints: kernels.Constraints
    compliance: NDArray[np.float64]
    ease: NDArray[np.float64]
    choice: str
    facts: dict[str, float] = field(default_factory=dict)

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The positions after each pass over all springs; the yielded array is overwritten by the next one."""
        p, tension = blocks.anchors(problem), np.zeros_like(self.ease)
        while True:
            kernels.iterate(self.constraints, self.ease, self.compliance, tension, p, 1)
            yield p

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """All of the iterations that `stop` allows."""
        p, tension = blocks.anchors(problem), np.zeros_like(self.ease)
        kernels.iterate(self.constraints, self.ease, self.compliance, tension, p, stop.iterations)
        return Solution(p, stop.iterations, np.nan, np.nan, "iterations")

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """None: an iteration has no parts."""
        return {}


@dataclass(frozen=True, eq=False)
class PreparedSmallSteps:
    """constraints: the springs by colour."""

    system: System
    constraints: kernels.Constraints
    choice: str
    facts: dict[str, float] = field(default_factory=dict)

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The whole step in one substep, in two, and so on, each from the start."""
        for substeps in count(1):
            yield self._step(problem, substeps)[0]

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """The step in as many substeps as `stop` allows iterations, and the velocity at its end."""
        p, v = self._step(problem, stop.iterations)
        return Solution(p, stop.iterations, np.nan, np.nan, "iterations", v)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """None: an iteration has no parts."""
        return {}

    def _step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        s, pins, start = self.system, self.system.pins, problem.start
        h = s.time_step / substeps
        compliance, ease = _eased(self.constraints, blocks.held(replace(s, time_step=h)))
        begin = start.positions[pins.vertices]
        pinned = kernels.Pinned(pins.vertices.copy(), pins.weight.copy(), begin, problem.pin_targets.copy())
        p, v = start.positions.copy(), start.velocity.copy()
        force, before = problem.force.copy(), np.empty_like(p)
        kernels.substeps(self.constraints, ease, compliance, pinned, force, before, p, v, h, substeps)
        return p, v


def _prepared(system: System, held: NDArray[np.float64], solver: str) -> tuple[kernels.Constraints, str]:
    """The springs by colour, and that in words; self-loops, which stretch nothing, are left out."""
    springs = only_springs(system, solver)
    blocks.require_mass(system, held, solver)
    keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])
    coloured = colouring.of_springs(springs.edges[keep], system.vertices)
    constraints = kernels.Constraints.of(springs, keep[coloured.order])
    return constraints, f"springs in {coloured.colours} colours"


def _eased(
    constraints: kernels.Constraints, held: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The compliance 1/held (n,) [m/N], and how far each spring moves of what it would without one, (m,)."""
    compliance = 1.0 / held
    i, j = constraints.ends.T
    return compliance, 1.0 / (1.0 + constraints.stiffness * (compliance[i] + compliance[j]))
