"""Rows of `springbench ablate`: one Parquet file per scene, under `results/<scene>/ablation/`.

One table contains all kinds of rows; the column `kind` distinguishes them:

    full-scene   the scene with all effects that it lists
    ablated      the scene without some of its effects: their cost, and the change of the motion without them
    error        the distance of the full scene from a more accurate solution: of its solver, or of its time step
    suggestion   an effect that the scene does not list although its motion indicates it, with the evidence
    overhead     the overhead per iteration of one effect, or all, over a scene with only springs, gravity, drag and
                 pins
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

_TEXT, _INT, _REAL = pa.string(), pa.int64(), pa.float64()

ABLATION_COLUMNS = (
    ColumnSpec("kind", _TEXT, "", "full-scene, ablated, error, suggestion or overhead"),
    ColumnSpec(
        "name",
        _TEXT,
        "",
        "the omitted effects, joined by +; `solver` or `time-step`; of an overhead the effect, or `all`",
    ),
    *select_run_columns(
        "scene", "size", "vertices", "springs", "solver", "parameters", "plugins", "time_step", "integrator"
    ),
    *SOLVER_COLUMN_SPECS,
    *select_run_columns("initial_guess", "max_iterations", "residual_rtol", "error_requested", "threads"),
    ColumnSpec("frames", _INT, "", "number of simulated steps"),
    ColumnSpec("rounds", _INT, "", "number of timed repetitions of each step"),
    ColumnSpec(
        "status",
        _TEXT,
        "",
        "ok, unsolvable (no solution without the effects) or failed (an error); of full-scene and overhead as in runs",
    ),
    ColumnSpec("reason", _TEXT, "", "why the status is not ok; of a suggestion the evidence"),
    ColumnSpec(
        "seconds",
        _REAL,
        "s",
        "CPU time per step, mean over the frames of the median over the rounds; of an overhead, per iteration",
    ),
    ColumnSpec(
        "added_seconds",
        _REAL,
        "s",
        "CPU time per step that the effects add: the same statistic of the differences from the full scene",
    ),
    ColumnSpec("added_seconds_low", _REAL, "s", "lower end of its 95 % interval"),
    ColumnSpec("added_seconds_high", _REAL, "s", "upper end of its 95 % interval"),
    ColumnSpec(
        "overhead_ratio", _REAL, "", "CPU time of an iteration with the effect over one without, median over the rounds"
    ),
    ColumnSpec("overhead_ratio_low", _REAL, "", "lower end of its 95 % interval"),
    ColumnSpec("overhead_ratio_high", _REAL, "", "upper end of its 95 % interval"),
    ColumnSpec(
        "overhead_ratio_bound",
        _REAL,
        "",
        "lower bound: the effect's data are read once, by a dot product, or multiplied once, at the rate "
        "of a matrix product, whichever takes longer",
    ),
    ColumnSpec(
        "memory_bytes", _INT, "B", "memory of the built scene and the prepared solver, as Python's allocators see it"
    ),
    *select_run_columns("nnz_system"),
    ColumnSpec(
        "nnz_factor", _INT, "", "stored entries of the triangular factor L; of the Hessian's if one is computed"
    ),
    ColumnSpec("displacement_max", _REAL, "", "largest displacement of a vertex in any frame, in mean rest lengths"),
    ColumnSpec(
        "displacement_rms",
        _REAL,
        "",
        "root mean square of the displacements over vertices and frames, in mean rest lengths",
    ),
    ColumnSpec(
        "energy_difference",
        _REAL,
        "",
        "largest difference of kinetic and elastic energy in any frame, over its maximum",
    ),
    ColumnSpec(
        "centroid_displacement",
        _REAL,
        "",
        "largest displacement of the centre of mass in any frame, in mean rest lengths",
    ),
    ColumnSpec("bounding_box_diagonal", _REAL, "", "diagonal of the rest shape's bounding box, in mean rest lengths"),
    *PROVENANCE_COLUMN_SPECS,
)

ABLATION_SCHEMA = build_schema(ABLATION_COLUMNS)
