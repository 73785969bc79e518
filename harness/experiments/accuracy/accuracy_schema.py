"""Rows of `springbench accuracy`: one Parquet file for each unit of work, under `results/<name>/accuracy/`.

One table contains all kinds of rows; the column `kind` distinguishes them:

    snapshot       a step snapshot: its properties, and its energy at the current positions and at Liu's inertial target
    minimum        a known minimum of it; minimum_index 0 is the lowest
    prepare        the time that a solver needs to prepare for it
    curve          an iterate of a solver on it: energy, errors, stationarity, and its time
    work           a simulation up to `t_end`: its error, its wall time, and the CPU time of its best round
    error-control  a simulation to a requested error (`springbench run SCENE --error`)
    method         a method that was tried for it, at its first setting
    third-party    a simulation to the same error by the third-party integrator `solver` (`--compare`)

Rows contain energies and errors of positions, never gaps. Gaps are computed on reading from `objective`,
`objective_initial` and the lowest `objective` of the minima, so that a better minimum needs no new measurement.
"""

from __future__ import annotations

import pyarrow as pa
from springbench.harness.results.run_schema import (
    PROVENANCE_COLUMN_SPECS,
    SOLVER_COLUMN_SPECS,
    ColumnSpec,
    build_schema,
    select_run_columns,
)

_TEXT, _INT, _REAL, _BOOL = pa.string(), pa.int64(), pa.float64(), pa.bool_()

ACCURACY_COLUMNS = (
    ColumnSpec("kind", _TEXT, "", "snapshot, minimum, prepare, curve, work, error-control, method or third-party"),
    ColumnSpec("unit_id", _TEXT, "", "hash of everything that determines the unit's result and timing"),
    *select_run_columns(
        "sweep", "scene", "size", "vertices", "springs", "solver", "parameters", "integrator", "time_step"
    ),
    *SOLVER_COLUMN_SPECS,
    *select_run_columns("initial_guess", "threads"),
    ColumnSpec(
        "status",
        _TEXT,
        "",
        "ok, saddle, unsupported, diverged, energy-growth, no-progress, time-limit, failed, killed or "
        "uncertified (the reference)",
    ),
    *select_run_columns("reason"),
    ColumnSpec(
        "problem_digest",
        _TEXT,
        "",
        "digest of the step snapshot, of the reference trajectory, or of the problem with a requested error",
    ),
    ColumnSpec("snapshot", _TEXT, "", "name of the step snapshot: early, middle, peak, or frame-k"),
    ColumnSpec("frame", _INT, "", "step of the snapshot, from 1"),
    ColumnSpec("stiffness_ratio", _REAL, "", "k dt^2/m of the median stiffness and the mean mass of the free vertices"),
    ColumnSpec("mean_rest_length", _REAL, "m", "mean rest length of the springs with stiffness"),
    ColumnSpec("objective_initial", _REAL, "J", "objective of the step at the current positions"),
    ColumnSpec(
        "objective_inertial", _REAL, "J", "objective of the step at the inertial target, with pins at their targets"
    ),
    ColumnSpec(
        "objective_magnitude", _REAL, "J", "sum of the absolute values of the objective's terms at the lowest minimum"
    ),
    ColumnSpec("minimum_index", _INT, "", "rank of a minimum by its energy, 0 is the lowest; null if none was reached"),
    ColumnSpec("minimum_id", _TEXT, "", "permanent name of a minimum; for a curve, the one to which its errors refer"),
    ColumnSpec("objective", _REAL, "J", "objective of the step, by the reference evaluator"),
    *select_run_columns("stationarity"),
    ColumnSpec("min_eigenvalue", _REAL, "N/m", "smallest eigenvalue of the Hessian at the minimum"),
    ColumnSpec(
        "is_certified", _BOOL, "", "whether the minimum is known to 1e-9 of its size, with a curvature above round-off"
    ),
    ColumnSpec("iteration", _INT, "", "number of the iterate, 0 is the initial guess"),
    ColumnSpec(
        "position_error_max_m", _REAL, "m", "largest distance of a vertex from its position in the minimum `minimum_id`"
    ),
    ColumnSpec("position_error_rms_m", _REAL, "m", "root mean square of these distances over the free vertices"),
    ColumnSpec(
        "seconds",
        pa.list_(_REAL),
        "s",
        "wall time of each round: of a warm preparation; since the start of the solve; of the whole simulation",
    ),
    ColumnSpec("preempted", _BOOL, "", "whether more than 3 % and 1 ms of a round passed without computing"),
    ColumnSpec("cold_seconds", _REAL, "s", "wall time of the solver's first preparation"),
    ColumnSpec("recording_path", _TEXT, "", "recording of the solve, relative to the results of this config"),
    ColumnSpec("max_iterations", _INT, "", "iteration limit of a step of a simulation, or of a curve"),
    *select_run_columns("residual_rtol"),
    ColumnSpec("t_end", _REAL, "s", "simulated time"),
    *select_run_columns("cpu_seconds"),
    ColumnSpec(
        "seconds_per_simulated_second", _REAL, "", "median over the rounds of wall seconds per simulated second"
    ),
    ColumnSpec(
        "error", _REAL, "", "|p(T) - reference(T)| / |reference(T) - p(0)|, Frobenius norms over the free vertices"
    ),
    ColumnSpec(
        "reference_kind", _TEXT, "", "kind of that reference: integrated, or self-converged where there is contact"
    ),
    ColumnSpec(
        "reference_error", _REAL, "", "bound on the error of that reference itself, relative to the displacement"
    ),
    ColumnSpec("end_error_rms_m", _REAL, "m", "root mean square distance of a vertex from the reference at `t_end`"),
    ColumnSpec("num_iterations", _INT, "", "iterations of all steps together"),
    *select_run_columns("solver_description"),
    *select_run_columns(
        "error_requested",
        "error_estimated",
        "step_atol_m",
        "num_accepted_steps",
        "num_rejected_steps",
        "num_factorisations",
        "search_seconds",
    ),
    ColumnSpec("provided_energy", _REAL, "J", "kind `error-control`: energy provided in the whole motion"),
    *(
        ColumnSpec(f"dissipation_{cause}", _REAL, "J", f"kind `error-control`: energy that {words} in the whole motion")
        for cause, words in (
            ("damping", "damping effects dissipated"),
            ("friction", "friction dissipated"),
            ("integrator", "the time integrator dissipated"),
            ("solve", "unconverged solves dissipated"),
        )
    ),
    ColumnSpec(
        "predicted_seconds",
        _REAL,
        "s",
        "kind `method`: predicted CPU time for the requested error, by the method's order",
    ),
    *select_run_columns("device", "device_memory_gib", "device_driver", "device_versions"),
    *PROVENANCE_COLUMN_SPECS,
)

ACCURACY_SCHEMA = build_schema(ACCURACY_COLUMNS)
