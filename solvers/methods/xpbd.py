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
straight chain), and near to it where they turn little in a step. With `device: cuda` the same iterates come from
`solvers.cuda.xpbd`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from solvers.about import About, Reference
from solvers.core import colouring, vertex_terms
from solvers.core.driver import Iterating, Iterative, Substeps
from solvers.core.prefactored import only_springs
from solvers.device import Precise
from solvers.kernels import xpbd as kernels
from solvers.kernels.loop import ITERATIONS, ONE, Limits
from solvers.problem import Positions, Prepared, ResidualOf, StepProblem, System


@dataclass(frozen=True)
class Xpbd(Precise):
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

    def prepare(self, system: System) -> Prepared:
        """Raises Unsupported for energies other than springs, and for vertices without mass that are not pinned."""
        held = vertex_terms.held(system)
        if self.device == "cuda":
            return _on_device(self, system, held, "xpbd", small=False)
        constraints, _, choice = _prepared(system, held, "xpbd")
        return PreparedXpbd(system, constraints, *_eased(constraints, held), choice)


@dataclass(frozen=True)
class XpbdSmallSteps(Precise):
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

    def prepare(self, system: System) -> Prepared:
        """Raises Unsupported as `Xpbd` does, and for integrators other than implicit Euler."""
        vertex_terms.require_implicit_euler(system, "xpbd-small-steps")
        held = vertex_terms.held(system)
        if self.device == "cuda":
            return _on_device(self, system, held, "xpbd-small-steps", small=True)
        constraints, _, choice = _prepared(system, held, "xpbd-small-steps")
        return PreparedSmallSteps(system, constraints, choice)


@dataclass(frozen=True, eq=False)
class PreparedXpbd(Iterative):
    """constraints: the springs by colour; compliance: 1/held (n,) [m/N]; ease (m,): see the kernels."""

    residual_of: ClassVar[ResidualOf] = "none"

    system: System
    constraints: kernels.Constraints
    compliance: NDArray[np.float64]
    ease: NDArray[np.float64]
    choice: str
    facts: dict[str, float] = field(default_factory=dict)

    def begin(self, problem: StepProblem, guess: Positions) -> Passes:
        """See Iterative; from where the vertices would go without springs."""
        return Passes(self, vertex_terms.anchors(problem))


class Passes(Iterating):
    """One pass over all springs after another. tension: t of each (m,) [N], in the order of `constraints`."""

    def __init__(self, prepared: PreparedXpbd, p: Positions) -> None:
        self._prepared, self.tension, self.positions = prepared, np.zeros_like(prepared.ease), p

    def advance(self) -> bool:
        """See Iterating."""
        self.iterate(ONE)
        return True

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """See Iterating."""
        made = self._prepared
        kernels.iterate(made.constraints, made.ease, made.compliance, self.tension, self.positions, limits.iterations)
        return limits.iterations, float("nan"), ITERATIONS


@dataclass(frozen=True, eq=False)
class PreparedSmallSteps(Iterative):
    """constraints: the springs by colour."""

    residual_of: ClassVar[ResidualOf] = "none"

    system: System
    constraints: kernels.Constraints
    choice: str
    facts: dict[str, float] = field(default_factory=dict)

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """See Iterative; from where the step starts."""
        return Substeps(self.step, problem)

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Positions [m] and velocity [m/s] after the step in so many substeps."""
        s, pins, start = self.system, self.system.pins, problem.start
        h = s.time_step / substeps
        compliance, ease = _eased(self.constraints, vertex_terms.held(replace(s, time_step=h)))
        begin = start.positions[pins.vertices]
        pinned = kernels.Pinned(pins.vertices.copy(), pins.weight.copy(), begin, problem.pin_targets.copy())
        p, v = start.positions.copy(), start.velocity.copy()
        force, before = problem.force.copy(), np.empty_like(p)
        kernels.substeps(self.constraints, ease, compliance, pinned, force, before, p, v, h, substeps)
        return p, v


def _on_device(method: Precise, system: System, held: NDArray[np.float64], solver: str, *, small: bool) -> Prepared:
    """See `solvers.cuda.xpbd`."""
    from solvers.cuda.device import ready  # for those who ask for it

    ready(solver)
    from solvers.cuda.xpbd import prepare

    constraints, first, choice = _prepared(system, held, solver)
    return prepare(system, constraints, first, method.real, choice, small=small)


def _prepared(
    system: System, held: NDArray[np.float64], solver: str
) -> tuple[kernels.Constraints, NDArray[np.int64], str]:
    """The springs by colour, the first of each (colours + 1,), and that in words; self-loops, which stretch nothing,
    are left out."""
    springs = only_springs(system, solver)
    vertex_terms.require_mass(system, held, solver)
    keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])
    coloured = colouring.of_springs(springs.edges[keep], system.vertices)
    constraints = kernels.Constraints.of(springs, keep[coloured.order])
    return constraints, coloured.start, f"springs in {coloured.colours} colours"


def _eased(
    constraints: kernels.Constraints, held: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The compliance 1/held (n,) [m/N], and how far each spring moves of what it would without one, (m,)."""
    compliance = 1.0 / held
    i, j = constraints.ends.T
    return compliance, 1.0 / (1.0 + constraints.stiffness * (compliance[i] + compliance[j]))
