"""Accelerated first-order methods with one prefactored matrix: Anderson, Chebyshev and L-BFGS.

They share the iteration (`solvers.kernels.accelerate`) and differ in the coefficients of a direction. A step
is fully compiled if the energies are springs, quadratic forms, strain limits and dashpots, and the factor's panels are
supported by the kernels. Otherwise the kernels alternate with the energies' own values and gradients, and with the
factor's own solve.

No iteration raises the objective, except by round-off. A trial that would is shortened, or replaced by the plain
correction, a local-global iteration, which descends by majorisation. If that does not descend either, within round-off,
the solve terminates as "stalled" and its iterate stays unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from solvers.contact.touching import without_contact
from solvers.core.acceleration import Accelerating, Engine, Interpreted, Scheme, window_for
from solvers.core.bounds import without_bounded
from solvers.core.compiled import FAR, PreparedCompiled, compiled
from solvers.core.driver import Iterative, largest
from solvers.core.fixed_objective import Objective
from solvers.core.objective import StepObjective
from solvers.core.parts import Parts
from solvers.core.prefactored import PreparedLocalGlobal, prepared, projective
from solvers.kernels import accelerate_step, step_ends
from solvers.kernels.accelerate import Window
from solvers.kernels.accelerate_coefficients import require_pairs
from solvers.kernels.accelerate_springs import Shares
from solvers.kernels.edges import Edges
from solvers.kernels.loop import ONE, Limits, at_most
from solvers.linear.choice import Linear, Precision, factorise
from solvers.memory import aligned
from solvers.problem import Positions, ProjectiveEnergy, StepProblem, System


def prepare(system: System, scheme: Scheme, linear: Linear, precision: Precision) -> PreparedAccelerated:
    """Factorise Q and compile the iteration.

    Args:
        system: the system.
        scheme: coefficients of the acceleration.
        linear: solver of Q x = b.
        precision: floating-point type of its stored entries.

    Raises:
        Unsupported: for energies that the method does not support.
        NotPositiveDefinite: if the system leaves some positions undetermined.
    """
    bare = without_contact(system)
    energies = (
        projective(without_bounded(bare), scheme.name)
        if scheme.projective
        else [energy for energy in bare.energies if isinstance(energy, ProjectiveEnergy)]
    )
    base = prepared(bare, energies, lambda Q: factorise(Q, linear, precision))
    found = compiled(base, corrects=True)
    known = isinstance(found, PreparedCompiled)
    base = found.base if known else replace(base, choice=f"{base.choice}; {found}")
    engine: Engine = _Compiled(scheme, found) if known else _Any(scheme, system, base)
    if bare is not system:
        from solvers.contact.quasi_newton import Touching  # for those who need it

        engine = Touching(scheme, system, base, engine)
    return PreparedAccelerated(base, engine)


@dataclass(frozen=True)
class Windowed:
    """Base class of methods with a history of recent iterations.

    Args:
        pairs: number of stored differences.
        linear: solver of Q x = b.
        precision: floating-point type of its stored entries.
    """

    minimises: ClassVar[bool] = True
    descends: ClassVar[bool] = True

    pairs: int = 5
    linear: Linear = "auto"
    precision: Precision = "float64"

    def __post_init__(self) -> None:
        """Raise ValueError if a parameter is out of range."""
        require_pairs(self.pairs)


@dataclass(frozen=True, eq=False)
class PreparedAccelerated(Iterative):
    """An accelerated method, prepared: `base` has the prefactored Q, `engine` iterates."""

    base: PreparedLocalGlobal
    engine: Engine

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.base.facts

    @property
    def choice(self) -> str:
        """Description of the linear solver."""
        return self.base.choice

    def begin(self, problem: StepProblem, guess: Positions) -> Accelerating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return self.engine.begin(problem, guess)

    def scale(self, problem: StepProblem) -> float:
        """Return the residual [J^(1/2)] scale, below a small part of which round-off is checked."""
        return largest(problem) * self.base.trace**0.5


class _Compiled:
    """Compiled iteration for springs and similar energies, with a factor that is split into blocks."""

    def __init__(self, scheme: Scheme, compiled: PreparedCompiled) -> None:
        self._scheme = scheme
        self._parts, self._edges, self._form = compiled.parts, compiled.edges, compiled.form
        plan, bundles, self._rows = compiled.plan, compiled.bundles, compiled.rows
        pins = compiled.base.system.pins
        self._entries = 4 * int(plan.blocks[:, 1].max())
        self._plan, self._bundles, self._far = plan, bundles, compiled.far
        self._shares = Shares.of(bundles, plan.held, self._rows.row[pins.vertices[pins.exact]])
        self._idle: list[_State] = []

    def _new(self) -> _State:
        whole = 4 * len(self._plan.held)
        window = window_for(self._scheme, self._entries, whole, self._plan.squares.dtype)
        window.trial[4 * self._far] = FAR
        x = aligned(whole, self._plan.squares.dtype)
        vectors = self._bundles.right(self._plan.held), x, aligned(whole), np.zeros(3)
        return accelerate_step.Step(self._plan, self._bundles, self._form, self._shares, self._rows, *vectors), window

    def begin(self, problem: StepProblem, guess: Positions) -> Accelerating:
        """Start a solve from an initial guess (n, 3) [m]."""
        state = self._idle.pop() if self._idle else self._new()
        edges, given = self._parts.begun(self._edges, problem), (problem, guess)
        return _CompiledAccelerating(self._idle, state, self._parts, edges, *given)


_State = tuple[accelerate_step.Step, Window]
"""Work arrays of a solve."""


class _CompiledAccelerating(Accelerating):
    """State of a compiled solve; `idle` receives its work arrays when it is deleted."""

    def __init__(
        self,
        idle: list[_State],
        state: _State,
        parts: Parts,
        edges: Edges | None,
        problem: StepProblem,
        guess: Positions,
    ) -> None:
        self._idle, self._memory = idle, state
        step, window = state
        self._state = step, edges, window
        # The kernels are compiled for writable arrays.
        given = [np.array(x, order="C") for x in (problem.target, parts.force(problem), problem.pin_targets, guess)]
        step.objective[2] = parts.negative(guess)
        self.positions = np.empty_like(guess)
        accelerate_step.start(*self._state, *given)
        step.objective[1] += parts.size(guess)

    def iterate(self, limits: Limits) -> tuple[int, float, int]:
        """Run iterations within the limits; return their number, the residual and the reason of the end."""
        return accelerate_step.run(*self._state, limits, self.positions)

    def advance(self) -> bool:
        """Do one iteration; return False if round-off prevents any further change."""
        return self.iterate(ONE)[0] == 1

    def residual(self) -> float:
        """Return the residual [J^(1/2)] of the iterate that `residual_of` names."""
        return self.iterate(at_most(0))[1]

    @property
    def fallen(self) -> float:
        """Decrease of the objective so far [J], unless round-off hides it."""
        return float(self._state[-1].now["fallen"][0])

    def gradient(self) -> Positions:
        """Return the gradient of the objective (n, 3) [N] at the current point."""
        step, _, window = self._state
        out = np.empty_like(self.positions)
        step_ends.fetch(step.rows, window.descent, out)
        return np.negative(out, out=out)

    def __del__(self) -> None:
        self._idle.append(self._memory)


class _Any:
    """Interpreted iteration for all energies and all factors."""

    def __init__(self, scheme: Scheme, system: System, base: PreparedLocalGlobal) -> None:
        self._scheme, self._base, self._objective = scheme, base, Objective(system)

    def begin(self, problem: StepProblem, guess: Positions) -> Accelerating:
        """Start a solve from an initial guess (n, 3) [m]."""
        return Interpreted(self._base, self._scheme, StepObjective(self._objective, problem), guess)
