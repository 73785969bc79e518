"""Rows of `springbench accuracy`: one Parquet file for each unit of work, under `results/<name>/accuracy/`.

One table contains all kinds of rows; the column `kind` distinguishes them:

    problem   a step snapshot: its properties, and its energy at the current positions and at Liu's inertial target
    minimum   a known minimum of it; branch 0 is the lowest
    prepare   the time that a solver needs to prepare for it
    curve     an iterate of a solver on it: energy, errors, stationarity, and its time
    work      a simulation up to the horizon: its error, its wall time, and the CPU time of its best round
    asked     a simulation to a requested error (`springbench run SCENE --error`)
    way       a method that was tried for it, at its first setting
    peer      a simulation to the same error by a third-party integrator (`--compare`), whose name is `solver`

Rows contain energies and errors of positions, never gaps. Gaps are computed on reading from `g`, `g0` and the lowest
`g` of the minima, so that a better minimum needs no new measurement.
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
    ColumnSpec("kind", _TEXT, "", "problem, minimum, prepare, curve, work, asked, way or peer"),
    ColumnSpec("unit", _TEXT, "", "hash of all that determines the unit's result and timing"),
    *select_run_columns(
        "sweep", "scene", "size", "vertices", "springs", "solver", "parameters", "integrator", "time_step"
    ),
    *SOLVER_COLUMN_SPECS,
    *select_run_columns("first_guess", "threads"),
    ColumnSpec(
        "status",
        _TEXT,
        "",
        "ok, saddle, unsupported, diverged, energy-growth, no-progress, time-limit, failed, killed or uncertified (the "
        "reference)",
    ),
    *select_run_columns("reason"),
    ColumnSpec("problem", _TEXT, "", "digest of the frozen step, of the reference trajectory, or of what was asked"),
    ColumnSpec("moment", _TEXT, "", "early, middle, violent, or frame-k"),
    ColumnSpec("frame", _INT, "", "the step that was frozen, from 1"),
    ColumnSpec("stiffness_ratio", _REAL, "", "k dt^2/m: median stiffness and mean mass of what is not pinned"),
    ColumnSpec("mean_rest_length", _REAL, "m", "of the springs that have stiffness"),
    ColumnSpec("g0", _REAL, "J", "the step's objective at the current positions"),
    ColumnSpec("g0_inertial", _REAL, "J", "the step's objective at the inertial target, pins on theirs"),
    ColumnSpec("magnitude", _REAL, "J", "sum of the absolute values of the objective's terms at the lowest minimum"),
    ColumnSpec("branch", _INT, "", "number of a minimum by its energy, 0 is the lowest; null where none was reached"),
    ColumnSpec("minimum", _TEXT, "", "name of a minimum, which stays; of a curve the one that its errors refer to"),
    ColumnSpec("g", _REAL, "J", "the step's objective, by the oracle"),
    *select_run_columns("stationarity"),
    ColumnSpec("smallest_eigenvalue", _REAL, "N/m", "of the Hessian at the minimum, computed there"),
    ColumnSpec(
        "certified",
        _BOOL,
        "",
        "whether the minimum is known to 1e-9 of its size, with a curvature above round-off",
    ),
    ColumnSpec("iteration", _INT, "", "number of the iterate, 0 is the first guess"),
    ColumnSpec("largest_error", _REAL, "m", "largest distance of a vertex from its place in the minimum `minimum`"),
    ColumnSpec("rms_error", _REAL, "m", "root mean square of these distances over the vertices that are not pinned"),
    ColumnSpec(
        "seconds",
        pa.list_(_REAL),
        "s",
        "wall time of each round: of a warm preparation; since the start of the solve; of the whole horizon",
    ),
    ColumnSpec("interrupted", _BOOL, "", "whether more than 3 % and 1 ms of a round went by without computing"),
    ColumnSpec("cold", _REAL, "s", "wall time of the first time that the solver was prepared"),
    ColumnSpec("recording", _TEXT, "", "the solve as a recording, relative to the results of this config"),
    ColumnSpec("iterations", _INT, "", "the iteration limit, of a step of work or of a curve"),
    *select_run_columns("tolerance"),
    ColumnSpec("horizon", _REAL, "s", "simulated time"),
    *select_run_columns("cpu_seconds"),
    ColumnSpec("seconds_per_simulated", _REAL, "", "median over the rounds of wall seconds per simulated second"),
    ColumnSpec(
        "error", _REAL, "", "|p(T) - reference(T)| / |reference(T) - p(0)|, Frobenius norms, vertices not pinned"
    ),
    ColumnSpec("truth", _TEXT, "", "what that reference is: integrated, or self-converged where there is contact"),
    ColumnSpec("error_rms_m", _REAL, "m", "root mean square distance of a vertex from the reference at the horizon"),
    ColumnSpec("iterations_done", _INT, "", "iterations done in all steps together"),
    *select_run_columns("choice"),
    *select_run_columns(
        "asked", "estimated", "local_tolerance_m", "accepted", "rejected", "factorisations", "estimate_seconds"
    ),
    ColumnSpec("promised", _REAL, "s", "of a way: processor time that it would take to the error asked, by its order"),
    *select_run_columns("device", "device_memory_gib", "device_driver", "device_versions"),
    *PROVENANCE_COLUMN_SPECS,
)

ACCURACY_SCHEMA = build_schema(ACCURACY_COLUMNS)
