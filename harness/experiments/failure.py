"""Convert the error that ended a measurement to status and reason."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from harness.base.blame import said, where
from harness.base.errors import InputError, RunFailed
from harness.base.files import CannotWrite
from harness.config.sweep import RunSpec
from harness.experiments.code import solver_class
from harness.simulation.energy_balance import Growth
from harness.simulation.measure import Diverged, StepFailed
from solvers.core.clearing import Blocked
from solvers.problem import NotPositiveDefinite, Unsupported, WrongAnswer
from solvers.registry import minimises

_STATUS: dict[type[BaseException], str] = {Unsupported: "unsupported", Diverged: "diverged"}


def failure(error: BaseException, own: Collection[Path] = ()) -> dict[str, Any]:
    """Return the row of a run that ended with an error, without the common columns.

    The row has the frame number if a step failed.

    Args:
        error: the error that ended the run.
        own: source files of the solver; the reported error location is in these where possible.

    Raises:
        CannotWrite: if this is the error.
    """
    if isinstance(error, CannotWrite):  # that is no outcome: a row of it would keep the run from being done again
        raise error
    if isinstance(error, StepFailed) and error.__cause__:
        return failure(error.__cause__, own) | {"frame": error.frame}
    return {"phase": "run", "status": _STATUS.get(type(error), "failed"), "reason": _reason(error, own)}


def grown(run: RunSpec, growth: Growth, by_frame: Mapping[int, Mapping[str, Any]]) -> dict[str, str]:
    """Return `status` and `reason` of a finished run whose energy has grown without a source.

    Args:
        run: specification of the run.
        growth: the energy growth and its first frame.
        by_frame: columns of the rows, by frame.
    """
    times = f"{growth.times:,.0f}" if growth.times >= 10.0 else f"{growth.times:.1f}"
    said = f"energy has grown {times} times without a source, from frame {growth.first} on: "
    step = by_frame[growth.first]
    if step["stopped"] == "iterations" and step["iterations"] >= run.iterations and run.integrator != "own":
        said += f"{run.solver.name} leaves the step unsolved; take more iterations, a tolerance, or another solver"
    else:
        integrates = run.integrator == "own" or not minimises(solver_class(run))  # a method with steps of its own
        method = run.solver.name if integrates else run.integrator
        said += f"a step of {run.scene.time_step:.3g} s is too long for {method}"
    return {"status": "energy-growth", "reason": said}


def _reason(error: BaseException, own: Collection[Path]) -> str:
    """Return the text of an error of springbench.

    For any other error the text includes type and location.
    """
    if isinstance(error, (Unsupported, NotPositiveDefinite, WrongAnswer, Blocked, Diverged, RunFailed, InputError)):
        return str(error)
    return f"{said(error)} ({where(error, set(map(str, own)))})"
