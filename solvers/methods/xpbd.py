"""Extended position based dynamics (XPBD): springs as compliant constraints, projected one after another.

XPBD (Macklin, Mueller and Chentanez 2016) starts at the positions without springs, with zero tensions. An iteration
passes over all springs and moves the two ends of each spring, so that its accumulated tension t becomes
k (|p_i - p_j| - r):

    dt = (k (|p_i - p_j| - r) - t) / (1 + k (1/q_i + 1/q_j)),    p_i -= dt/q_i n,    p_j += dt/q_j n

with n the direction of the spring and q = c m/dt^2 + w the anchor stiffness of a vertex, so that pins of any weight
need no separate constraints (see `solvers.methods.base.vertex_terms`). This is the paper's formula in terms of forces,
lambda = -t dt^2, and valid from k = 0 to the largest k. Small steps (Macklin et al. 2019) divides the time step
instead, with one iteration per substep.

Neither minimises the objective of the step. Tensions are accumulated along directions that rotate during the iteration,
without correction terms. The fixed point is the minimiser if springs do not rotate (a straight chain), and close to it
if they rotate little in a step. `device: cuda` computes the same iterates in `solvers.cuda.device_xpbd`.
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
    """XPBD; uses neither the initial guess nor a tolerance."""

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
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, and for unpinned vertices without mass.
        """
        held = vertex_terms.held(system)
        if self.device == "cuda":
            return _on_device(self, system, held, "xpbd", small=False)
        constraints, _, choice = _prepared(system, held, "xpbd")
        return PreparedXpbd(system, constraints, *_eased(constraints, held), choice)


@dataclass(frozen=True)
class XpbdSmallSteps(Precise):
    """XPBD with small steps: as many substeps of one iteration as the stop rule has iterations.

    The k-th iterate is the whole step in k substeps. Pins move at constant velocity, and forces are constant within a
    step. Neither the initial guess nor a tolerance is used.
    """

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
        """Prepare the method for a system.

        Raises:
            Unsupported: as for `Xpbd`, and for integrators other than implicit Euler.
        """
        vertex_terms.require_implicit_euler(system, "xpbd-small-steps")
        held = vertex_terms.held(system)
        if self.device == "cuda":
            return _on_device(self, system, held, "xpbd-small-steps", small=True)
        constraints, _, choice = _prepared(system, held, "xpbd-small-steps")
        return PreparedSmallSteps(system, constraints, choice)


@dataclass(frozen=True, eq=False)
class PreparedXpbd(Iterative):
    """XPBD, prepared for a system.

    Attributes:
        constraints: the springs by colour.
        compliance: 1/q (n,) [m/N].
        ease: (m,), documented with the kernels.
    """

    residual_of: ClassVar[ResidualOf] = "none"

    system: System
    constraints: kernels.Constraints
    compliance: NDArray[np.float64]
    ease: NDArray[np.float64]
    choice: str
    facts: dict[str, float] = field(default_factory=dict)

    def begin(self, problem: StepProblem, guess: Positions) -> Passes:
        """Start a solve at the positions that the vertices have without springs."""
        return Passes(self, vertex_terms.anchors(problem))


class Passes(Iterating):
    """State of an XPBD solve; `tension` t (m,) [N] in the order of `constraints`."""

    def __init__(self, prepared: PreparedXpbd, p: Positions) -> None:
        self._prepared, self.tension, self.positions = prepared, np.zeros_like(prepared.ease), p

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents any further change."""
        self.iterate(ONE)
        return True

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Run iterations within the limits; return their number, the residual and the reason of the end."""
        made = self._prepared
        kernels.iterate(made.constraints, made.ease, made.compliance, self.tension, self.positions, limits.iterations)
        return limits.iterations, float("nan"), ITERATIONS


@dataclass(frozen=True, eq=False)
class PreparedSmallSteps(Iterative):
    """XPBD with small steps, prepared; `constraints` are the springs by colour."""

    residual_of: ClassVar[ResidualOf] = "none"

    system: System
    constraints: kernels.Constraints
    choice: str
    facts: dict[str, float] = field(default_factory=dict)

    def begin(self, problem: StepProblem, guess: Positions) -> Iterating:
        """Start a solve at the start of the step."""
        return Substeps(self.step, problem)

    def step(self, problem: StepProblem, substeps: int) -> tuple[Positions, Positions]:
        """Integrate the step in `substeps` substeps; return positions [m] and velocities [m/s]."""
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
    """Prepare the method on a CUDA device (`solvers.cuda.device_xpbd`)."""
    from solvers.cuda.device import ready  # for those who ask for it

    ready(solver)
    from solvers.cuda.xpbd import prepare

    constraints, first, choice = _prepared(system, held, solver)
    return prepare(system, constraints, first, method.real, choice, small=small)


def _prepared(
    system: System, held: NDArray[np.float64], solver: str
) -> tuple[kernels.Constraints, NDArray[np.int64], str]:
    """Group the springs by colour, without self-loops, which have no elongation.

    Returns:
        The constraints, the first constraint of each colour (colours + 1,), and a description.
    """
    springs = only_springs(system, solver)
    vertex_terms.require_mass(system, held, solver)
    keep = np.flatnonzero(springs.edges[:, 0] != springs.edges[:, 1])
    coloured = colouring.of_springs(springs.edges[keep], system.vertices)
    constraints = kernels.Constraints.of(springs, keep[coloured.order])
    return constraints, coloured.start, f"springs in {coloured.colours} colours"


def _eased(
    constraints: kernels.Constraints, held: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the compliance 1/q (n,) [m/N], and the relative displacement of each spring (m,)."""
    compliance = 1.0 / held
    i, j = constraints.ends.T
    return compliance, 1.0 / (1.0 + constraints.stiffness * (compliance[i] + compliance[j]))
