"""Remarks on solvers whose solves leave few digits of the positions.

The local-global methods solve Q p = b for positions, with an error that `springbench.solvers.model.solve_accuracy`
bounds. Newton's method solves for corrections, with gradients that are accurate to the last digits of the springs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.iteration.solver_info import LOCAL_GLOBAL_FAMILY
from springbench.solvers.model.solve_accuracy import SolveAccuracy
from springbench.solvers.model.step_problem import Positions, Solver, System
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, find_solver_info, load_target

MIN_DIGITS = 4.0
"""Digits of a spring's length below which solves are remarked on."""

_BUILT_IN = SOLVERS | OPTIONAL_SOLVERS

_REMEDY = "take `newton` or `hybrid`"


def describe_inaccurate_solvers(scene: Scene, names: Iterable[str]) -> str:
    """Describe the solvers that keep few digits of the positions at the start.

    Args:
        scene: the scene.
        names: names of solvers that `solves_with_system_matrix` selects.

    Returns:
        The description, with a remedy; empty if all solvers are accurate.
    """
    accuracy = SolveAccuracy.from_system(scene.system, scene.start.compute_positions(scene.mesh.rest_positions))
    if accuracy is None or accuracy.num_digits >= MIN_DIGITS:
        return ""
    concerned = [name for name in names if _solves_for_positions(load_target(_BUILT_IN[name]), accuracy)]
    return f"{', '.join(concerned)}: {accuracy}; {_REMEDY}" if concerned else ""


def solves_with_system_matrix(name: str, parameters: Mapping[str, Any]) -> bool:
    """Return whether a solver is a built-in local-global method with a factor in float64.

    Factors of low precision are tested when they are made, and replaced where corrections diverge.

    Args:
        name: name of the solver.
        parameters: its parameters.
    """
    return (
        name in _BUILT_IN
        and parameters.get("precision", "float64") == "float64"
        and find_solver_info(load_target(_BUILT_IN[name]), name).family == LOCAL_GLOBAL_FAMILY
    )


def explain_residual(solver: Solver, system: System, p: Positions, residual: float) -> str:
    """Explain a wrong residual by rounding errors that may be as large.

    Args:
        solver: solver of the step.
        system: system of the step.
        p: positions that the solver returned (n, 3) [m].
        residual: residual at these positions [J^(1/2)].

    Returns:
        The cause and a remedy, to be appended to a message; empty if rounding errors are smaller.
    """
    accuracy = SolveAccuracy.from_system(system, p, getattr(solver, "precision", "float64"))
    if accuracy is None or not _solves_for_positions(type(solver), accuracy):
        return ""
    return f": {accuracy}; {_REMEDY}" if accuracy.explains_residual(residual) else ""


def _solves_for_positions(kind: type, accuracy: SolveAccuracy) -> bool:
    """Return whether a solver solves for positions, or for corrections with a rounded factor."""
    if find_solver_info(kind, "").family != LOCAL_GLOBAL_FAMILY:
        return False
    return accuracy.precision != "float64" or accuracy.num_digits >= getattr(kind, "min_direct_digits", 0.0)
