"""Wrapper of prepared solvers, and the check of a solver's contract.

The contract prescribes the types of results, and permits no writes to inputs. The check is outside of timed code. Error
messages state the line of the solver that its author can correct, not the line of the harness that failed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import RunFailed
from springbench.harness.execution.error_location import locate_error
from springbench.solvers.iteration.iterative_solver import IterativeSolver
from springbench.solvers.jit import source_digest
from springbench.solvers.model.step_problem import (
    Positions,
    PreparedSolver,
    Solution,
    Solver,
    StepProblem,
    StopRule,
    System,
)


class DelegatingSolver:
    """Delegates the members of a prepared solver, except `solve`, which subclasses define."""

    def __init__(self, prepared: PreparedSolver) -> None:
        self._prepared = prepared

    @property
    def description(self) -> str:
        """The solver's description."""
        return self._prepared.description

    @property
    def stats(self) -> dict[str, float]:
        """The solver's statistics."""
        return self._prepared.stats

    @property
    def has_inner_solves(self) -> bool:
        """Whether the solver iterates within the frames that it integrates itself."""
        return getattr(self._prepared, "has_inner_solves", False)

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        """Return the solver's iterates."""
        return self._prepared.iterates(problem)

    def iteration_phases(self, problem: StepProblem) -> dict[str, Callable[[], object]]:
        """Return the solver's phases of an iteration."""
        return self._prepared.iteration_phases(problem)

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        """Return the solver's residual [J^(1/2)]; nan if it is not defined.

        Args:
            problem: step problem that defines the objective.
            p: positions (n, 3) [m].
        """
        return self._prepared.residual_at(problem, p)


Arrays = dict[str, NDArray[Any]]


_REQUIRED_METHODS, _REQUIRED_PROPERTIES = (
    ("iterates", "solve", "residual_at", "iteration_phases"),
    ("description", "stats"),
)
"""Methods and properties of a prepared solver (`springbench.solvers.model.step_problem.PreparedSolver`)."""


class SolverContract:
    """Copies of a solver's inputs before it is prepared."""

    def __init__(self, system: System, solver: Solver) -> None:
        self._system, self._solver = system, solver
        self._before = {name: array.copy() for name, array in _collect_system_arrays(system).items()}

    def wrap_prepared(self, prepared: Any) -> ContractCheckedSolver:
        """Wrap the prepared solver with checks.

        Args:
            prepared: result of the solver's `prepare`.

        Raises:
            RunFailed: `prepare` modified the system, or its result lacks a method or property.
        """
        line = _locate_method(type(self._solver), "prepare")
        self.require_unmodified(line)
        lacks = [name for name in _REQUIRED_METHODS if not callable(getattr(prepared, name, None))]
        lacks += [name for name in _REQUIRED_PROPERTIES if not hasattr(prepared, name)]
        if lacks:
            got = "None" if prepared is None else f"a {type(prepared).__name__}"
            raise RunFailed(f"{line}: `prepare` gave {got}, which has no `{'`, `'.join(lacks)}`")
        return ContractCheckedSolver(
            prepared, self, frozenset(map(str, source_digest.find_class_sources(type(self._solver))))
        )

    def require_unmodified(self, line: str) -> None:
        """Raise RunFailed if the system has been modified."""
        written = _find_differences(self._before, _collect_system_arrays(self._system))
        if written:
            raise RunFailed(f"{line}: wrote to {', '.join(written)}, which is an input; change a copy")


class ContractCheckedSolver(DelegatingSolver):
    """A prepared solver with a check of every solve."""

    def __init__(self, prepared: PreparedSolver, contract: SolverContract, user_files: Collection[str]) -> None:
        super().__init__(prepared)
        self._contract, self._own = contract, user_files

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the solver's solution after checking it.

        Args:
            problem: step problem, which the solver must not modify.
            stop: stop rule of the solve.

        Raises:
            RunFailed: the result is no `Solution`, its positions have a wrong shape or type, or an input was modified.
        """
        before = {name: array.copy() for name, array in _collect_problem_arrays(problem).items()}
        found: Any = self._prepared.solve(problem, stop)
        usual: Any = getattr(self._prepared, "usual", self._prepared)
        line = _locate_method(usual.__class__, "solve")
        written = _find_differences(before, _collect_problem_arrays(problem))
        if written:
            line = self._locate_write(_restore_problem(problem, before), stop) or line
            raise RunFailed(f"{line}: wrote to {', '.join(written)}, which is an input; change a copy")
        self._contract.require_unmodified(line)
        if not isinstance(found, Solution):
            raise RunFailed(
                f"{line}: gave a {type(found).__name__}; expected a springbench.solvers.model.step_problem.Solution"
            )
        p: Any = found.positions
        got = f"{p.dtype} of shape {p.shape}" if _is_array(p) else f"a {type(p).__name__}"
        if got != (expected := f"float64 of shape {problem.inertial_target.shape}"):
            raise RunFailed(f"{line}: gave positions as {got}; expected {expected}")
        return found

    def _locate_write(self, problem: StepProblem, stop: StopRule) -> str:
        """Locate the line that writes to the problem; "" where none is found.

        The solve is repeated with read-only arrays.
        """
        for array in _collect_problem_arrays(problem).values():
            array.flags.writeable = False
        try:
            self._prepared.solve(problem, stop)
        except ValueError as error:
            return locate_error(error, self._own)
        except Exception:  # a compiled solver may not take such arrays at all
            return ""
        return ""


def _locate_method(owner: type, method: str) -> str:
    function: Callable[..., Any] | None = getattr(owner, method, None)
    if getattr(function, "__module__", "") == IterativeSolver.__module__:  # an inherited loop
        function = getattr(owner, "init_state", None)
    code = getattr(function, "__code__", None)
    return (
        f"{Path(code.co_filename).name}:{code.co_firstlineno}"
        if code
        else f"{owner.__module__}.{owner.__name__}.{method}"
    )


def _collect_problem_arrays(problem: StepProblem) -> Arrays:
    named = {f"problem.{f.name}": getattr(problem, f.name) for f in fields(problem)}
    named |= {f"problem.step_start.{f.name}": getattr(problem.step_start, f.name) for f in fields(problem.step_start)}
    return {name: value for name, value in named.items() if _is_array(value)}


def _restore_problem(problem: StepProblem, arrays: Arrays) -> StepProblem:
    """Return the problem with copies of the given arrays."""
    copies = {name: array.copy() for name, array in arrays.items()}
    begun = {
        f.name: copies.get(f"problem.step_start.{f.name}", getattr(problem.step_start, f.name))
        for f in fields(problem.step_start)
    }
    own = {name.removeprefix("problem."): array for name, array in copies.items() if "step_start." not in name}
    return replace(problem, step_start=replace(problem.step_start, **begun), **own)


def _collect_system_arrays(system: System) -> Arrays:
    named: dict[str, Any] = {"system.mass": system.mass}
    named |= {f"system.pins.{f.name}": getattr(system.pins, f.name) for f in fields(system.pins)}
    for energy in system.energies:
        named |= {f"{type(energy).__name__}.{name}": value for name, value in _iterate_attributes(energy)}
    return {name: value for name, value in named.items() if _is_array(value)}


def _is_array(value: object) -> TypeGuard[NDArray[Any]]:
    return isinstance(value, np.ndarray)


def _iterate_attributes(energy: Any) -> Iterator[tuple[str, Any]]:
    if is_dataclass(energy):
        return ((f.name, getattr(energy, f.name)) for f in fields(energy))
    own: dict[str, Any] = getattr(energy, "__dict__", {})
    return iter(own.items())


def _find_differences(before: Arrays, after: Arrays) -> list[str]:
    """Return the names of the arrays that are not bitwise identical."""
    return [name for name, array in before.items() if array.tobytes() != after[name].tobytes()]
