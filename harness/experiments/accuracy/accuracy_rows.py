"""Rows of `springbench accuracy`: one Parquet file for each unit of work, under `results/<name>/accuracy/`.

One table contains all kinds of rows; the column `kind` distinguishes them:

    problem   a step snapshot: its properties, and its energy at the current positions and at Liu's inertial target
    minimum   a known minimum of it; branch 0 is the lowest
    prepare   the time that a solver needs to prepare for it
    curve     an iterate of a solver on it: energy, errors, stationarity, and its time
    work      a simulation up to the horizon: its error, its wall time, and the CPU time of its best round
    asked     a simulation to a requested error (`springbench run SCENE --error`)
    way       a method that was tried for it, at its first setting
    peer      a simulation to the same error by a third-party integrator (`--peers`), whose name is `solver`
    goal      the CPU time of the cheapest method for an error, compared with a baseline (`springbench goals`)

Rows contain energies and errors of positions, never gaps. Gaps are computed on reading from `g`, `g0` and the lowest
`g` of the minima, so that a better minimum needs no new measurement.
"""

from __future__ import annotations

import pyarrow as pa

from harness.base.columns import OF_SOLVER, PROVENANCE, Column, as_in_runs, schema_of

_TEXT, _INT, _REAL, _YES = pa.string(), pa.int64(), pa.float64(), pa.bool_()

COLUMNS = (
    Column("kind", _TEXT, "", "problem, minimum, prepare, curve, work, asked, way, peer or goal"),
    Column("unit", _TEXT, "", "hash of all that determines the unit's result and timing"),
    *as_in_runs("sweep", "scene", "size", "vertices", "springs", "solver", "parameters", "integrator", "time_step"),
    *OF_SOLVER,
    *as_in_runs("first_guess", "threads"),
    Column(
        "status",
        _TEXT,
        "",
        "ok, saddle, unsupported, diverged, no-progress, time-limit, failed, killed or uncertified (the reference)",
    ),
    *as_in_runs("reason"),
    Column("problem", _TEXT, "", "digest of the frozen step, of the reference trajectory, or of what was asked"),
    Column("moment", _TEXT, "", "early, middle, violent, or frame-k"),
    Column("frame", _INT, "", "the step that was frozen, from 1"),
    Column("stiffness_ratio", _REAL, "", "k dt^2/m: median stiffness and mean mass of what is not pinned"),
    Column("mean_rest_length", _REAL, "m", "of the springs that have stiffness"),
    Column("g0", _REAL, "J", "the step's objective at the current positions"),
    Column("g0_inertial", _REAL, "J", "the step's objective at the inertial target, pins on theirs"),
    Column("magnitude", _REAL, "J", "sum of the absolute values of the objective's terms at the lowest minimum"),
    Column("branch", _INT, "", "number of a minimum by its energy, 0 is the lowest; null where none was reached"),
    Column("minimum", _TEXT, "", "name of a minimum, which stays; of a curve the one that its errors refer to"),
    Column("g", _REAL, "J", "the step's objective, by the oracle"),
    *as_in_runs("stationarity"),
    Column("smallest_eigenvalue", _REAL, "N/m", "of the Hessian at the minimum, computed there"),
    Column(
        "certified",
        _YES,
        "",
        "whether the minimum is known to 1e-9 of its size, with a curvature above round-off",
    ),
    Column("iteration", _INT, "", "number of the iterate, 0 is the first guess"),
    Column("largest_error", _REAL, "m", "largest distance of a vertex from its place in the minimum `minimum`"),
    Column("rms_error", _REAL, "m", "root mean square of these distances over the vertices that are not pinned"),
    Column(
        "seconds",
        pa.list_(_REAL),
        "s",
        "wall time of each round: of a warm preparation; since the start of the solve; of the whole horizon",
    ),
    Column("interrupted", _YES, "", "whether more than 3 % and 1 ms of a round went by without computing"),
    Column("cold", _REAL, "s", "wall time of the first time that the solver was prepared"),
    Column("recording", _TEXT, "", "the solve as a recording, relative to the results of this config"),
    Column("iterations", _INT, "", "the iteration limit, of a step of work or of a curve"),
    *as_in_runs("tolerance"),
    Column("horizon", _REAL, "s", "simulated time"),
    *as_in_runs("cpu_seconds"),
    Column("seconds_per_simulated", _REAL, "", "median over the rounds of wall seconds per simulated second"),
    Column("error", _REAL, "", "|p(T) - reference(T)| / |reference(T) - p(0)|, Frobenius norms, vertices not pinned"),
    Column("truth", _TEXT, "", "what that reference is: integrated, or self-converged where there is contact"),
    Column("error_rms_m", _REAL, "m", "root mean square distance of a vertex from the reference at the horizon"),
    Column("iterations_done", _INT, "", "iterations done in all steps together"),
    *as_in_runs("choice"),
    *as_in_runs(
        "asked", "estimated", "local_tolerance_m", "accepted", "rejected", "factorisations", "estimate_seconds"
    ),
    Column("promised", _REAL, "s", "of a way: processor time that it would take to the error asked, by its order"),
    Column("against", _TEXT, "", "of a goal: what was held against it, the best of its kind"),
    Column("against_error", _REAL, "", "its error, estimated as that of the goal"),
    Column("against_seconds", _REAL, "s", "its processor time, in the process of the goal's (`cpu_seconds`)"),
    Column("wanted", _REAL, "", "the part of that which is wanted"),
    *as_in_runs("device", "device_memory_gib", "device_driver", "device_versions"),
    *PROVENANCE,
)

SCHEMA = schema_of(COLUMNS)
