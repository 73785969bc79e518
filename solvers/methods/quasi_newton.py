"""Accelerated first-order methods over one prefactored matrix: `anderson`, `chebyshev` and `lbfgs`.

They share the iteration (`solvers.kernels.accelerate`) and differ in a direction's coefficients. Where the energies
are springs, quadratic forms, strain limits and dashpots, and the factor is one whose panels the kernels know, a step is
compiled as a whole; else the same kernels take turns with the energies' own values and gradients, and with the factor's
own solve.

No iteration raises the objective, round-off apart: a trial that would is shortened or replaced by the plain
correction, a local-global iteration, which descends by majorisation. Where that does not either, for all that round-off
tells, the solve has "stalled", and its iterates stay where they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from solvers.contact.touching import without_contact
from solvers.core.objective import Objective, StepObjective
from solvers.core.parts import Parts
from solvers.kernels import accelerate, accelerate_step, step_ends
from solvers.kernels.accelerate import Window
from solvers.kernels.accelerate_springs import Shares
from solvers.kernels.edges import Edges
from solvers.linear.choice import Linear, Precision, factorise
from solvers.memory import aligned
from solvers.methods.local_global import PreparedLocalGlobal, prepared, projective
from solvers.methods.local_global_compiled import FAR, PreparedCompiled, compiled
from solvers.problem import Positions, ProjectiveEnergy, Solution, StepProblem, StopRule, System


@dataclass(frozen=True)
class Method:
    """name: in the registry; coefficients: which, see `accelerate_coefficients`; pairs: kept in the window; retries:
    shorter steps along a direction before the plain correction; projective: whether other energies are refused."""

    name: str
    coefficients: int
    pairs: int
    retries: int
    projective: bool


class Run(Protocol):
    """A solve that has begun. positions (n, 3): where it is; largest: coordinate of the first guess."""

    positions: Positions
    largest: float

    @property
    def fallen(self) -> float:
        """By how much the objective fell so far [J], where round-off does not hide it."""
        ...

    def advance(self, iterations: int, limit: float, floor: float, every: bool) -> tuple[int, float, bool]:
        """Iterate, as `accelerate_step.run` does."""
        ...

    def gradient(self) -> Positions:
        """That of the objective [N], (n, 3), where it is."""
        ...


def prepare(system: System, method: Method, linear: Linear, precision: Precision) -> PreparedAccelerated:
    """Factorise Q and compile. Raises Unsupported for energies that the method does not take, NotPositiveDefinite."""
    bare = without_contact(system)
    energies = (
        projective(bare, method.name)
        if method.projective
        else [energy for energy in bare.energies if isinstance(energy, ProjectiveEnergy)]
    )
    base = prepared(bare, energies, lambda Q: factorise(Q, linear, precision))
    found = compiled(base, corrects=True)
    known = isinstance(found, PreparedCompiled)
    base = found.base if known else replace(base, choice=f"{base.choice}; {found}")
    engine: Engine = _Compiled(method, found) if known else _Interpreted(method, base)
    if bare is not system:
        from solvers.contact.quasi_newton import Touching  # for those who need it

        engine = Touching(method, base, engine)
    return PreparedAccelerated(base, engine)


class Engine(Protocol):
    """Begins solves."""

    def begin(self, problem: StepProblem, guess: Positions) -> Run:
        """A run from a first guess (n, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class PreparedAccelerated:
    """A method, ready for a system. base: the prefactored Q; engine: what iterates."""

    base: PreparedLocalGlobal
    engine: Engine

    @property
    def facts(self) -> dict[str, float]:
        """Exact counts of what was built."""
        return self.base.facts

    @property
    def choice(self) -> str:
        """The linear solver in words."""
        return self.base.choice

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """The iterates from `problem.first_guess`; the yielded array is overwritten by the next one."""
        run = self.engine.begin(problem, problem.first_guess)
        while True:
            run.advance(1, np.nan, 0.0, False)
            yield run.positions

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Iterate until `stop` says so, or round-off; without a tolerance only the last residual is computed."""
        every, limit, yardstick = stop.tolerance is not None, 0.0, float("nan")
        if stop.tolerance is not None:
            _, yardstick, _ = self.engine.begin(problem, problem.current).advance(0, 0.0, 0.0, False)
            limit = stop.tolerance * yardstick
        run = self.engine.begin(problem, problem.first_guess)
        floor = stop.floor * run.largest * self.base.trace**0.5
        count, residual, stalled = run.advance(stop.iterations, limit, floor, every)
        stopped = "iterations"
        if every and count and residual <= max(limit, floor):
            stopped = "tolerance" if residual <= limit else "floor"
        elif stalled:
            stopped = "stalled"
        return Solution(run.positions, count, residual, yardstick, stopped)

    def phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """None: an iteration has no parts that stand alone."""
        return {}


def window_for(method: Method, entries: int, whole: int, precision: Any = np.float64) -> Window:
    """Memory for the unknowns' entries, in vectors that have `whole` of them; precision: the factor's."""
    m = method.pairs
    now = np.zeros(1, accelerate.NOW)
    now["method"], now["retries"] = method.coefficients, method.retries
    steps, images, correction, direction = (aligned(k * entries, precision) for k in (m, m, 1, 1))
    position, trial, descent, there = (aligned(whole) for _ in range(4))
    sy, wy = np.zeros((2, m, m))
    sg, wg, a, b = np.zeros((4, m))
    block = aligned(accelerate.BLOCK)
    return Window(
        steps, images, position, trial, descent, there, correction, direction, block, sy, wy, sg, wg, a, b, now
    )


class _Compiled:
    """Springs and what is like them, over a factor that is cut into blocks."""

    def __init__(self, method: Method, compiled: PreparedCompiled) -> None:
        self._method = method
        self._parts, self._edges, self._form = compiled.parts, compiled.edges, compiled.form
        plan, bundles, self._rows = compiled.plan, compiled.bundles, compiled.rows
        pins = compiled.base.system.pins
        self._entries = 4 * int(plan.blocks[:, 1].max())
        self._plan, self._bundles, self._far = plan, bundles, compiled.far
        self._shares = Shares.of(bundles, plan.held, self._rows.row[pins.vertices[pins.exact]])
        self._idle: list[_State] = []

    def _new(self) -> _State:
        whole = 4 * len(self._plan.held)
        window = window_for(self._method, self._entries, whole, self._plan.squares.dtype)
        window.trial[4 * self._far] = FAR
        x = aligned(whole, self._plan.squares.dtype)
        vectors = self._bundles.right(self._plan.held), x, aligned(whole), np.zeros(3)
        return accelerate_step.Step(self._plan, self._bundles, self._form, self._shares, self._rows, *vectors), window

    def begin(self, problem: StepProblem, guess: Positions) -> Run:
        """See Engine."""
        state = self._idle.pop() if self._idle else self._new()
        return _CompiledRun(self._idle, state, self._parts, self._parts.begun(self._edges, problem), problem, guess)


_State = tuple[accelerate_step.Step, Window]
"""The memory of a run."""


class _CompiledRun:
    """See Run. idle: where its memory goes when it is not needed any more."""

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
        given = (problem.target, parts.force(problem), problem.pin_targets, guess)
        step.objective[2] = parts.negative(guess)
        self.positions = np.empty_like(guess)
        # The kernels are compiled for arrays that may be written to.
        self.largest = accelerate_step.start(*self._state, *(np.array(x, order="C") for x in given))
        step.objective[1] += parts.size(guess)

    def advance(self, iterations: int, limit: float, floor: float, every: bool) -> tuple[int, float, bool]:
        """See Run."""
        return accelerate_step.run(*self._state, iterations, limit, floor, every, self.positions)

    @property
    def fallen(self) -> float:
        """See Run."""
        return float(self._state[-1].now["fallen"][0])

    def gradient(self) -> Positions:
        """See Run."""
        step, _, window = self._state
        out = np.empty_like(self.positions)
        step_ends.fetch(step.rows, window.descent, out)
        return np.negative(out, out=out)

    def __del__(self) -> None:
        self._idle.append(self._memory)


class _Interpreted:
    """Any energies, and any factor."""

    def __init__(self, method: Method, base: PreparedLocalGlobal) -> None:
        self._method, self._base, self._objective = method, base, Objective(base.system)

    def begin(self, problem: StepProblem, guess: Positions) -> Run:
        """See Engine."""
        window = window_for(self._method, guess.size, guess.size)
        return InterpretedRun(self._base, window, StepObjective(self._objective, problem), guess)


class InterpretedRun:
    """See Run."""

    def __init__(self, base: PreparedLocalGlobal, window: Window, objective: StepObjective, guess: Positions) -> None:
        self._base, self._window, self._objective = base, window, objective
        self.positions, self._trial, self._there = (
            x.reshape(-1, 3) for x in (window.position, window.trial, window.descent_there)
        )
        self._image = np.zeros_like(self._trial)
        self._trial[:] = objective.placed(guess)
        self.largest = float(np.abs(self._trial).max(initial=0.0))
        self._look()
        accelerate.begin(window, self._solved())

    def _look(self) -> None:
        np.negative(self._objective.gradient(self._trial), out=self._there)

    def _solved(self) -> NDArray[np.float64]:
        self._base.correction(self._there, self._image)
        return self._image.ravel()

    def _accept(self) -> None:
        accelerate.accept(self._window, self._solved())

    def _residual(self) -> float:
        e = self._window.correction.reshape(-1, 3).copy()
        e[self._base.system.pins.vertices] = 0.0
        return self._base.norm(e)

    @property
    def fallen(self) -> float:
        """See Run."""
        return float(self._window.now["fallen"][0])

    def gradient(self) -> Positions:
        """See Run."""
        return -self._window.descent.reshape(-1, 3)

    def advance(self, iterations: int, limit: float, floor: float, every: bool) -> tuple[int, float, bool]:
        """See Run; the loop of `accelerate_step.run`."""
        window, now = self._window, self._window.now
        residual = self._residual() if iterations == 0 else np.inf
        count, verdict = 0, accelerate.AGAIN
        while count < iterations and not (every and residual <= max(limit, floor)):
            accelerate.propose(window)
            verdict = accelerate.AGAIN
            while verdict == accelerate.AGAIN:
                self._look()
                rise, noise = self._objective.rise(self.positions, self._trial)
                now["rise"], now["noise"] = rise, noise
                verdict = accelerate.judge(window)
            if verdict == accelerate.STALLED:
                return count, self._residual(), True
            count += 1
            self._accept()
            if every or count == iterations:
                residual = self._residual()
        return count, residual, False
