"""Rows of `springbench ablate`: one Parquet file per scene, under `results/<scene>/ablation/`.

One table contains all kinds of rows; the column `kind` distinguishes them:

    whole        the scene with all effects that it lists
    without      the scene without some of its effects: their cost, and the change of the motion without them
    error        the distance of the full scene from a more accurate solution: of its solver, or of its time step
    suggestion   an effect that the scene does not list although its motion indicates it, with the evidence
    price        the per-iteration overhead of one effect, or all, over a scene with springs, gravity, drag and pins
    only
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
    ColumnSpec("kind", _TEXT, "", "whole, without, error, suggestion or price"),
    ColumnSpec(
        "name", _TEXT, "", "the effects left out, joined by +; `solver` or `time-step`; a price's effect, or `all`"
    ),
    *select_run_columns(
        "scene", "size", "vertices", "springs", "solver", "parameters", "own", "time_step", "integrator"
    ),
    *SOLVER_COLUMN_SPECS,
    *select_run_columns("first_guess", "max_iterations", "tolerance", "asked", "threads"),
    ColumnSpec("frames", _INT, "", "steps simulated"),
    ColumnSpec("rounds", _INT, "", "how often each of them was timed"),
    ColumnSpec(
        "status",
        _TEXT,
        "",
        "ok, impossible (no solution without the effects), unknown (an error); of whole and price as in runs",
    ),
    ColumnSpec("reason", _TEXT, "", "why the status is not ok; of a suggestion the evidence"),
    ColumnSpec(
        "seconds",
        _REAL,
        "s",
        "CPU time per step, the mean over frames of the median over rounds; of a price, per iteration",
    ),
    ColumnSpec("cost", _REAL, "s", "what the effects cost a step: the same of the differences from the whole scene"),
    ColumnSpec("cost_low", _REAL, "s", "lower end of its 95 % interval"),
    ColumnSpec("cost_high", _REAL, "s", "upper end of its 95 % interval"),
    ColumnSpec(
        "price", _REAL, "", "CPU time of an iteration with the effect over one without, the median over the rounds"
    ),
    ColumnSpec("price_low", _REAL, "", "lower end of its 95 % interval"),
    ColumnSpec("price_high", _REAL, "", "upper end of its 95 % interval"),
    ColumnSpec(
        "price_bound",
        _REAL,
        "",
        "lower bound: the effect's own numbers are read once, by a dot product, or multiplied once, at the "
        "rate of a matrix product, whichever takes longer",
    ),
    ColumnSpec("bytes", _INT, "B", "memory of the bound scene and the prepared solver, as Python's allocators see it"),
    *select_run_columns("nnz_system"),
    ColumnSpec("nnz_factor", _INT, "", "stored entries of the triangular factor L: of the Hessian's where one is made"),
    ColumnSpec("largest", _REAL, "", "largest displacement of a vertex in any frame, in mean rest lengths"),
    ColumnSpec(
        "rms", _REAL, "", "root mean square of the displacements over vertices and frames, in mean rest lengths"
    ),
    ColumnSpec("energy", _REAL, "", "largest difference of kinetic and elastic energy in any frame, over its largest"),
    ColumnSpec("centre", _REAL, "", "largest displacement of the centre of mass in any frame, in mean rest lengths"),
    ColumnSpec("extent", _REAL, "", "the diagonal of the rest shape's bounding box, in mean rest lengths"),
    *PROVENANCE_COLUMN_SPECS,
)

ABLATION_SCHEMA = build_schema(ABLATION_COLUMNS)
