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

from harness.base.columns import OF_SOLVER, PROVENANCE, Column, as_in_runs, schema_of

_TEXT, _INT, _REAL = pa.string(), pa.int64(), pa.float64()

COLUMNS = (
    Column("kind", _TEXT, "", "whole, without, error, suggestion or price"),
    Column("name", _TEXT, "", "the effects left out, joined by +; `solver` or `time-step`; a price's effect, or `all`"),
    *as_in_runs("scene", "size", "vertices", "springs", "solver", "parameters", "own", "time_step", "integrator"),
    *OF_SOLVER,
    *as_in_runs("first_guess", "max_iterations", "tolerance", "asked", "threads"),
    Column("frames", _INT, "", "steps simulated"),
    Column("rounds", _INT, "", "how often each of them was timed"),
    Column(
        "status",
        _TEXT,
        "",
        "ok, impossible (no solution without the effects), unknown (an error); of whole and price as in runs",
    ),
    Column("reason", _TEXT, "", "why the status is not ok; of a suggestion the evidence"),
    Column(
        "seconds",
        _REAL,
        "s",
        "CPU time per step, the mean over frames of the median over rounds; of a price, per iteration",
    ),
    Column("cost", _REAL, "s", "what the effects cost a step: the same of the differences from the whole scene"),
    Column("cost_low", _REAL, "s", "lower end of its 95 % interval"),
    Column("cost_high", _REAL, "s", "upper end of its 95 % interval"),
    Column("price", _REAL, "", "CPU time of an iteration with the effect over one without, the median over the rounds"),
    Column("price_low", _REAL, "", "lower end of its 95 % interval"),
    Column("price_high", _REAL, "", "upper end of its 95 % interval"),
    Column(
        "price_bound",
        _REAL,
        "",
        "lower bound: the effect's own numbers are read once, by a dot product, or multiplied once, at the "
        "rate of a matrix product, whichever takes longer",
    ),
    Column("bytes", _INT, "B", "memory of the bound scene and the prepared solver, as Python's allocators see it"),
    *as_in_runs("nnz_system"),
    Column("nnz_factor", _INT, "", "stored entries of the triangular factor L: of the Hessian's where one is made"),
    Column("largest", _REAL, "", "largest displacement of a vertex in any frame, in mean rest lengths"),
    Column("rms", _REAL, "", "root mean square of the displacements over vertices and frames, in mean rest lengths"),
    Column("energy", _REAL, "", "largest difference of kinetic and elastic energy in any frame, over its largest"),
    Column("centre", _REAL, "", "largest displacement of the centre of mass in any frame, in mean rest lengths"),
    Column("extent", _REAL, "", "the diagonal of the rest shape's bounding box, in mean rest lengths"),
    *PROVENANCE,
)

SCHEMA = schema_of(COLUMNS)
