"""Metadata of solvers as columns of rows.

Reports read these columns and need not import the solvers, which may be user code.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any, NamedTuple

from springbench.harness.execution.source_cache import read_cached_text
from springbench.solvers.registry import (
    OPTIONAL_SOLVERS,
    SOLVER_TABLE,
    SOLVERS,
    find_solver_info,
    is_minimiser,
    load_target,
)


class SolverTraits(NamedTuple):
    """Properties of a registered solver by which methods are selected and coloured.

    The fields are those of `springbench.solvers.iteration.solver_info.SolverInfo`, and whether the iterates converge to
    a minimum.
    """

    family: str
    is_minimiser: bool
    is_substepping: bool
    is_family_default: bool
    supports_error_control: bool


def read_registered_traits() -> dict[str, SolverTraits]:
    """Return the traits of all registered solvers by name.

    They are cached on disk, because reading them imports all solvers.
    """
    targets = SOLVERS | OPTIONAL_SOLVERS

    def describe_traits() -> str:
        return json.dumps({name: _read_traits(name, load_target(target)) for name, target in targets.items()})

    known = json.loads(read_cached_text("traits", describe_traits, json.dumps(targets)))
    return {name: SolverTraits(*traits) for name, traits in known.items()}


def _read_traits(name: str, solver: Any) -> SolverTraits:
    info = find_solver_info(solver, name)
    return SolverTraits(
        info.family,
        is_minimiser(solver),
        info.is_substepping,
        info.is_family_default,
        info.supports_error_control,
    )


def list_packages(solver: str) -> tuple[str, ...]:
    """List the third-party distributions that a solver is an interface to."""
    if solver not in SOLVER_TABLE:
        return ()
    package = find_solver_info(load_target(SOLVER_TABLE[solver]), solver).package_name
    return (package,) if package else ()


def read_solver_metadata(solver: str) -> dict[str, Any]:
    """Read the columns `family`, `citation`, `is_minimiser` and `is_substepping` of a solver.

    The result is empty for an unknown name.
    """
    if solver not in SOLVER_TABLE:
        return {}
    method = load_target(SOLVER_TABLE[solver])
    info = find_solver_info(method, solver)
    return {
        "family": info.family,
        "citation": json.dumps(asdict(info.citation), ensure_ascii=False) if info.citation else None,
        "is_minimiser": is_minimiser(method),
        "is_substepping": info.is_substepping,
    }
