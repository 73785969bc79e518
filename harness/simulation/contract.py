"""Check of a solver's contract: types of its results, and no writes to its inputs.

The check is outside of timed code. Error messages state the line of the solver that its author can correct, not the
line of the harness that failed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray

from harness.base.blame import where
from harness.base.errors import RunFailed
from harness.simulation.passing import Passing
from solvers import sources
from solvers.core.driver import Iterative
from solvers.problem import Prepared, Solution, Solver, StepProblem, StopRule, System

Arrays = dict[str, NDArray[Any]]


_METHODS, _TOLD = ("iterates", "solve", "residual_at", "phases"), ("choice", "facts")
"""Methods and properties of a prepared solver (`solvers.problem.Prepared`)."""


class Contract:
    """Copies of a solver's inputs before it is prepared."""

    def __init__(self, system: System, solver: Solver) -> None:
        self._system, self._solver = system, solver
        self._before = {name: array.copy() for name, array in _of_system(system).items()}

    def checked(self, prepared: Any) -> Checked:
        """Wrap the prepared solver with checks; raises RunFailed if preparing modified the system."""
        line = _line(type(self._solver), "prepare")
        self.require_untouched(line)
        lacks = [name for name in _METHODS if not callable(getattr(prepared, name, None))]
        lacks += [name for name in _TOLD if not hasattr(prepared, name)]
        if lacks:
            came = "None" if prepared is None else f"a {type(prepared).__name__}"
            raise RunFailed(f"{line}: `prepare` gave {came}, which has no `{'`, `'.join(lacks)}`")
        return Checked(prepared, self, frozenset(map(str, sources.of_class(type(self._solver)))))

    def require_untouched(self, line: str) -> None:
        """Raise RunFailed if the system has been modified."""
        written = _differing(self._before, _of_system(self._system))
        if written:
            raise RunFailed(f"{line}: wrote to {', '.join(written)}, which it was given; copy what is to be changed")


class Checked(Passing):
    """A prepared solver with a check of every solve."""

    def __init__(self, prepared: Prepared, contract: Contract, own: Collection[str]) -> None:
        super().__init__(prepared)
        self._contract, self._own = contract, own

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the solver's solution; raises RunFailed if it is invalid or an input was modified."""
        before = {name: array.copy() for name, array in _of_problem(problem).items()}
        found: Any = self._prepared.solve(problem, stop)
        usual: Any = getattr(self._prepared, "usual", self._prepared)
        line = _line(usual.__class__, "solve")
        written = _differing(before, _of_problem(problem))
        if written:
            line = self._writes(_restored(problem, before), stop) or line
            raise RunFailed(f"{line}: wrote to {', '.join(written)}, which it was given; copy what is to be changed")
        self._contract.require_untouched(line)
        if not isinstance(found, Solution):
            raise RunFailed(f"{line}: gave a {type(found).__name__}; wanted a solvers.problem.Solution")
        p: Any = found.positions
        came = f"{p.dtype} of shape {p.shape}" if _is_array(p) else f"a {type(p).__name__}"
        if came != (wanted := f"float64 of shape {problem.target.shape}"):
            raise RunFailed(f"{line}: gave positions as {came}; wanted {wanted}")
        return found

    def _writes(self, problem: StepProblem, stop: StopRule) -> str:
        """Locate the line that writes to the problem; "" where none is found.

        The solve is repeated with read-only arrays.
        """
        for array in _of_problem(problem).values():
            array.flags.writeable = False
        try:
            self._prepared.solve(problem, stop)
        except ValueError as error:
            return where(error, self._own)
        except Exception:  # a compiled solver may not take such arrays at all
            return ""
        return ""


def _line(of: type, method: str) -> str:
    function: Callable[..., Any] | None = getattr(of, method, None)
    if getattr(function, "__module__", "") == Iterative.__module__:  # the loop is not the solver's own
        function = getattr(of, "begin", None)
    code = getattr(function, "__code__", None)
    return f"{Path(code.co_filename).name}:{code.co_firstlineno}" if code else f"{of.__module__}.{of.__name__}.{method}"


def _of_problem(problem: StepProblem) -> Arrays:
    named = {f"problem.{f.name}": getattr(problem, f.name) for f in fields(problem)}
    named |= {f"problem.start.{f.name}": getattr(problem.start, f.name) for f in fields(problem.start)}
    return {name: value for name, value in named.items() if _is_array(value)}


def _restored(problem: StepProblem, arrays: Arrays) -> StepProblem:
    """Return the problem with copies of the given arrays."""
    copies = {name: array.copy() for name, array in arrays.items()}
    begun = {
        f.name: copies.get(f"problem.start.{f.name}", getattr(problem.start, f.name)) for f in fields(problem.start)
    }
    own = {name.removeprefix("problem."): array for name, array in copies.items() if "start." not in name}
    return replace(problem, start=replace(problem.start, **begun), **own)


def _of_system(system: System) -> Arrays:
    named: dict[str, Any] = {"system.mass": system.mass}
    named |= {f"system.pins.{f.name}": getattr(system.pins, f.name) for f in fields(system.pins)}
    for energy in system.energies:
        named |= {f"{type(energy).__name__}.{name}": value for name, value in _held(energy)}
    return {name: value for name, value in named.items() if _is_array(value)}


def _is_array(value: object) -> TypeGuard[NDArray[Any]]:
    return isinstance(value, np.ndarray)


def _held(energy: Any) -> Iterator[tuple[str, Any]]:
    if is_dataclass(energy):
        return ((f.name, getattr(energy, f.name)) for f in fields(energy))
    own: dict[str, Any] = getattr(energy, "__dict__", {})
    return iter(own.items())


def _differing(before: Arrays, after: Arrays) -> list[str]:
    """Return the names of the arrays that are not bitwise identical."""
    return [name for name, array in before.items() if array.tobytes() != after[name].tobytes()]
