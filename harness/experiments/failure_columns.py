"""Convert the error that ended a measurement to status and reason."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from springbench.harness.atomic_files import WriteError
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.execution.error_location import format_error, locate_error
from springbench.harness.experiments.provenance import load_solver_class
from springbench.harness.simulation.energy_balance import EnergyGrowth
from springbench.harness.simulation.timing_pass import DivergenceError, StepError
from springbench.solvers.contact.obstacle_advancement import NoClearance
from springbench.solvers.model.step_problem import NotPositiveDefinite, PluginContractError, Unsupported
from springbench.solvers.registry import is_minimiser

_STATUS_OF_ERROR: dict[type[BaseException], str] = {Unsupported: "unsupported", DivergenceError: "diverged"}


def build_failure_columns(error: BaseException, solver_files: Collection[Path] = ()) -> dict[str, Any]:
    """Return the row of a run that ended with an error, without the common columns.

    The row has the frame number if a step failed.

    Args:
        error: the error that ended the run.
        solver_files: source files of the solver; the reported error location is in these where possible.

    Raises:
        WriteError: `error`, if it is one.
    """
    if isinstance(error, WriteError):  # no outcome: a row would prevent a repetition
        raise error
    if isinstance(error, StepError) and error.__cause__:
        return build_failure_columns(error.__cause__, solver_files) | {"frame": error.frame}
    return {
        "phase": "run",
        "status": _STATUS_OF_ERROR.get(type(error), "failed"),
        "reason": _format_reason(error, solver_files),
    }


def build_energy_growth_columns(
    run: RunSpec, growth: EnergyGrowth, by_frame: Mapping[int, Mapping[str, Any]]
) -> dict[str, str]:
    """Return `status` and `reason` of a finished run whose energy has grown without a source.

    Args:
        run: specification of the run.
        growth: the energy growth and its first frame.
        by_frame: columns of the rows, by frame.
    """
    reason = f"{growth}: "
    step = by_frame[growth.first_frame]
    if (
        step["termination_reason"] == "max-iter"
        and step["num_iterations"] >= run.max_iterations
        and run.integrator != "substepping"
    ):
        reason += f"{run.solver.name} leaves the step unsolved; take more iterations, a tolerance, or another solver"
    else:
        integrates = run.integrator == "substepping" or not is_minimiser(
            load_solver_class(run)
        )  # a method with steps of its own
        method = run.solver.name if integrates else run.integrator
        reason += f"a step of {run.scene.time_step:.3g} s is too long for {method}"
    return {"status": "energy-growth", "reason": reason}


def _format_reason(error: BaseException, solver_files: Collection[Path]) -> str:
    """Return the text of an error of springbench.

    For any other error the text includes type and location.
    """
    if isinstance(
        error,
        (Unsupported, NotPositiveDefinite, PluginContractError, NoClearance, DivergenceError, RunFailed, InputError),
    ):
        return str(error)
    return f"{format_error(error)} ({locate_error(error, set(map(str, solver_files)))})"
