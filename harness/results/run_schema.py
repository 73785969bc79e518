"""Columns of the rows of a run: `RUN_COLUMNS` is both their schema and their documentation.

`results/README.md` shows the same table.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import pyarrow as pa


class ColumnSpec(NamedTuple):
    """One column: name, Arrow type, unit ("" if dimensionless) and description."""

    name: str
    type: pa.DataType
    unit: str
    description: str


_TEXT, _INT, _REAL = pa.string(), pa.int64(), pa.float64()

RUN_COLUMNS = (
    ColumnSpec("run_id", _TEXT, "", "hash of all that determines the run's result and timing"),
    ColumnSpec("sweep", _TEXT, "", "name of the sweep, the stem of its file"),
    ColumnSpec("scene", _TEXT, "", "name of the scene, the stem of its file"),
    ColumnSpec("size", _INT, "", "mesh size of the sweep; 0 where the mesh comes from a file"),
    ColumnSpec("solver", _TEXT, "", "name of the solver"),
    ColumnSpec("parameters", _TEXT, "", "the solver's parameters, as JSON"),
    ColumnSpec("family", _TEXT, "", "what the solver has in common with others; `local-global` is the paper's method"),
    ColumnSpec("reference", _TEXT, "", "where the solver's method comes from: authors, year, title and doi, as JSON"),
    ColumnSpec("minimises", pa.bool_(), "", "whether the solver's iterates tend to a minimum of the step's objective"),
    ColumnSpec("own_steps", pa.bool_(), "", "whether the solver integrates time in substeps of its own"),
    ColumnSpec("vertices", _INT, "", "vertices of the mesh"),
    ColumnSpec("springs", _INT, "", "springs of the mesh"),
    ColumnSpec(
        "modulus_exponent",
        _INT,
        "",
        "power of the mesh's spacing that the material's modulus (EA, E t or E) is proportional to, by the springs' "
        "rule; 0: every size is the same material; null: no rule, or several",
    ),
    ColumnSpec("time_step", _REAL, "s", "the time step dt"),
    ColumnSpec(
        "integrator", _TEXT, "", "how time is integrated, by name: implicit-euler, bdf2, midpoint, sdirk-4, ..."
    ),
    ColumnSpec(
        "first_guess", _TEXT, "", "where each step's iteration starts: assignment, current, inertial, motion or coarse"
    ),
    ColumnSpec("max_iterations", _INT, "", "the iteration limit of a step"),
    ColumnSpec(
        "tolerance",
        _REAL,
        "",
        "relative tolerance of the stop rule; null: all iterations are done; 0: auto",
    ),
    ColumnSpec("threads", _INT, "", "threads of Numba and of BLAS"),
    ColumnSpec("asked", _REAL, "", "the relative error at the end that was asked for; null: steps as they are stated"),
    ColumnSpec("estimated", _REAL, "", "where one was: that error, estimated by a motion to a closer tolerance"),
    ColumnSpec(
        "local_tolerance_m",
        _REAL,
        "m",
        "what each step may err by, root mean square over the free coordinates; null: steps of one length",
    ),
    ColumnSpec("accepted", _INT, "", "steps that kept to it"),
    ColumnSpec("rejected", _INT, "", "steps that did not, and were done again"),
    ColumnSpec(
        "factorisations", _INT, "", "factors made: one a length of steps, or one a linearly implicit step tried"
    ),
    ColumnSpec("estimate_seconds", _REAL, "s", "wall time of all that was simulated to choose and to estimate"),
    ColumnSpec(
        "phase",
        _TEXT,
        "",
        "prepare, step, local, global, iteration or run (the run as a whole), and what else a solver times; of a "
        "machine its kernel",
    ),
    ColumnSpec("frame", _INT, "", "the step, from 1; null where the phase has none"),
    ColumnSpec("round", _INT, "", "repetition of the measurement, from 0; prepare: 0 is cold, later ones are warm"),
    ColumnSpec(
        "seconds",
        _REAL,
        "s",
        "wall time of the phase; local and global: of one such step; iteration: of a whole solve next to these, over "
        "its iterations",
    ),
    ColumnSpec(
        "pass_seconds", _REAL, "s", "wall time, by another clock, of all of the phase in the run; of steps in the round"
    ),
    ColumnSpec("summed_seconds", _REAL, "s", "what the rows' times add up to in it"),
    ColumnSpec("cpu_seconds", _REAL, "s", "CPU time of the process in it"),
    ColumnSpec(
        "interrupted",
        pa.bool_(),
        "",
        "whether more than 3 % and 1 ms of it went by without computing: stopped, or others had the processor",
    ),
    ColumnSpec(
        "adds_up",
        pa.bool_(),
        "",
        "of the parts of an iteration: whether they add up to one within 15 %, by the medians over the frames",
    ),
    ColumnSpec("iterations", _INT, "", "iterations done in the step, for all of its unknowns"),
    ColumnSpec(
        "stages", _INT, "", "unknowns of the step that were solved for, one after the other; energies are the last's"
    ),
    ColumnSpec(
        "friction_rounds",
        _INT,
        "",
        "solves of the step, each with friction's normal forces from the one before; the most of its unknowns; null "
        "without friction",
    ),
    ColumnSpec(
        "friction_change",
        _REAL,
        "",
        "by what part of its largest force friction would change in a further round; the largest of its unknowns",
    ),
    ColumnSpec(
        "stopped",
        _TEXT,
        "",
        "what ended the step's iterations: iterations, tolerance, floor or stalled; the least welcome of its unknowns",
    ),
    ColumnSpec(
        "residual",
        _REAL,
        "J^(1/2)",
        "|Q^-1 grad g|_Q over the unpinned vertices at the positions that the step's solve returned; taken in the "
        "untimed pass where the solver knows that of the iterate before alone; null where it does not minimise",
    ),
    ColumnSpec(
        "last_residual",
        _REAL,
        "J^(1/2)",
        "the last one that the solve computed, by which the stop rule judged; null as the residual is",
    ),
    ColumnSpec("residual_of", _TEXT, "", "the iterate that last_residual belongs to: returned, previous or none"),
    ColumnSpec("within", _REAL, "J^(1/2)", "of `tolerance: auto`: the residual that was enough in the step"),
    ColumnSpec("yardstick", _REAL, "J^(1/2)", "the residual at the step's start, which the tolerance refers to"),
    ColumnSpec(
        "stationarity",
        _REAL,
        "",
        "where judged, and the solver minimises: |Q^-1 grad g|_Q at the answer, by the oracle, over the larger of "
        "its value at the current positions and round-off; of a step of several unknowns that of the worst",
    ),
    ColumnSpec("attainable", _REAL, "", "where judged: of the stationarity, what round-off may make at the answer"),
    ColumnSpec(
        "beyond",
        _REAL,
        "",
        "where judged: the stationarity of what round-off does not explain of the gradient, vertex by vertex; by this "
        "a step is graded",
    ),
    ColumnSpec("minimum", pa.bool_(), "", "where judged: whether the answer curves upwards beyond round-off"),
    ColumnSpec(
        "flat", pa.bool_(), "", "where judged: whether its smallest curvature cannot be told from zero: a valley"
    ),
    ColumnSpec(
        "graded",
        _REAL,
        "",
        "in the first, middle and last frame, but for solvers with steps of their own: the stationarity by the oracle, "
        "judged or not",
    ),
    ColumnSpec(
        "distance",
        _REAL,
        "",
        "where judged: largest distance of a vertex from where a run of Newton's method to round-off has it in that "
        "frame, over the size at rest of the component it belongs to; null from where that is lost",
    ),
    ColumnSpec(
        "formula_check",
        _TEXT,
        "",
        "where judged: how the energies are checked: release (all are shipped; tests of each release compare them with "
        "independently written formulas) or gradient (those from user code, by class: each gradient against the "
        "derivative of its energy's value at random points)",
    ),
    ColumnSpec("energy_springs", _REAL, "J", "elastic energy of the springs after the step"),
    ColumnSpec("energy_inertia", _REAL, "J", "inertia term of the step's objective"),
    ColumnSpec("energy_force", _REAL, "J", "external forces' term of the step's objective"),
    ColumnSpec("energy_pins", _REAL, "J", "pin penalty of the step's objective"),
    ColumnSpec(
        "energy_effects", _REAL, "J", "all other energies of the step's objective: bending, gas, damping and so on"
    ),
    ColumnSpec("objective", _REAL, "J", "the step's objective, the sum of all terms"),
    ColumnSpec(
        "energy_gained",
        _REAL,
        "J",
        "kinetic energy and potentials after the step, less those of the start and the work of sources; at most zero "
        "where nothing makes energy",
    ),
    ColumnSpec(
        "energy_available",
        _REAL,
        "J",
        "energy of the start, released potentials, work of sources, and what the load gives in one step; a larger gain "
        "is energy growth",
    ),
    ColumnSpec("largest_strain", _REAL, "", "largest |length / rest length - 1| of a spring after the step"),
    ColumnSpec(
        "strain_99",
        _REAL,
        "",
        "what 99 % of the springs stay below of it; the largest grows with the mesh where a single vertex bears a load",
    ),
    ColumnSpec(
        "off",
        _REAL,
        "",
        "where lengths are exact: the largest error of one after the step, over the longest that is allowed",
    ),
    ColumnSpec(
        "penetration",
        _REAL,
        "m",
        "how deep the deepest vertex is inside an obstacle after the step, 0 where none is; null without obstacles",
    ),
    ColumnSpec(
        "intersections",
        _INT,
        "",
        "edges that pass through triangles of the mesh, or of what it may not pass through, after the step, told "
        "exactly by code that no solver shares; null where no effect sees to that",
    ),
    ColumnSpec("digest", _TEXT, "", "SHA-256 of the positions after the step (float64 bytes)"),
    ColumnSpec(
        "recorded",
        _TEXT,
        "",
        "SHA-256 of the positions that the recording ends with, read back from its file (float32 bytes, relative to "
        "its origin)",
    ),
    ColumnSpec("nnz_system", _INT, "", "stored entries of the system matrix Q"),
    ColumnSpec("nnz_factor", _INT, "", "stored entries of its triangular factor, null where the library hides it"),
    ColumnSpec("nnz_hessian_factor", _INT, "", "stored entries of the triangular factor of Newton's Hessian"),
    ColumnSpec("panel_bytes", _INT, "", "bytes in which the prepared factor is stored"),
    ColumnSpec("flops_per_solve", _INT, "", "additions and multiplications of one global step, padding included"),
    ColumnSpec("choice", _TEXT, "", "what the solver chose by itself, and why"),
    ColumnSpec("device", _TEXT, "", "the device that the solver computed on, by name; null: the processor"),
    ColumnSpec("device_memory_gib", _REAL, "GiB", "memory of that device"),
    ColumnSpec("device_driver", _TEXT, "", "version of its driver"),
    ColumnSpec("device_versions", _TEXT, "", "versions of the libraries that reach it, as JSON"),
    ColumnSpec(
        "sm_clock_mhz", _REAL, "MHz", "clock of its processors after the round; null, as the next five: not told"
    ),
    ColumnSpec("memory_clock_mhz", _REAL, "MHz", "clock of its memory then"),
    ColumnSpec("power_w", _REAL, "W", "what it took then"),
    ColumnSpec("power_limit_w", _REAL, "W", "what it may take"),
    ColumnSpec("performance_state", _REAL, "", "its state then, 0 the fastest"),
    ColumnSpec("temperature_c", _REAL, "°C", "its temperature then"),
    ColumnSpec("kernel_seconds", _REAL, "s", "of the step's kernels on the device, by events on its stream"),
    ColumnSpec("transfer_seconds", _REAL, "s", "of what the step brings to the device and back, by events"),
    ColumnSpec(
        "apart", _REAL, "", "how far the precision of the factor moves converged positions, in the scene's size"
    ),
    ColumnSpec("bytes", _REAL, "", "bytes that the phase touches, vectors and springs included, by count"),
    ColumnSpec("flops", _REAL, "", "additions and multiplications of the phase, by count"),
    ColumnSpec("working_set", _REAL, "", "bytes that the phase goes through again and again"),
    ColumnSpec("load", _REAL, "", "load average over a minute when the phase was timed"),
    ColumnSpec(
        "status",
        _TEXT,
        "",
        "ok, unsupported, diverged, energy-growth (without a source), wrong-gradient (see formula_check), failed (an "
        "error, or a crash), time-limit, killed (from outside) or skipped",
    ),
    ColumnSpec("reason", _TEXT, "", "why the status is not ok"),
    ColumnSpec("time_limit", _REAL, "s", "wall time that the run might take; null: any"),
    ColumnSpec("memory_limit", _REAL, "GiB", "memory that the run might take; null: any"),
    ColumnSpec(
        "timing",
        _TEXT,
        "",
        "exclusive: timed alone on the machine; shared: on cores of its own, beside others; rough: in the pass that "
        "looks at it, beside others",
    ),
    ColumnSpec("at_once", _INT, "", "how many runs may have been timed at once"),
    ColumnSpec("pinned", _TEXT, "", "of shared timing: the cores' numbers"),
    ColumnSpec("machine", _TEXT, "", "id of the machine: hash of its processor, cores and memory"),
    ColumnSpec("node", _TEXT, "", "id of the computer among others like it: hash of its name"),
    ColumnSpec("cpu", _TEXT, "", "name of the processor"),
    ColumnSpec("cores", _INT, "", "cores this process may use"),
    ColumnSpec("memory_gib", _REAL, "GiB", "memory of the machine"),
    ColumnSpec(
        "machine_bandwidth", _REAL, "B/s", "bytes a second that one thread reads and writes where it copies 64 MiB"
    ),
    ColumnSpec("machine_flops", _REAL, "1/s", "operations a second of one thread in a product of matrices, float64"),
    ColumnSpec("machine_step", _REAL, "s", "a fixed step there: ten iterations of local-global by NumPy and SciPy"),
    ColumnSpec("system", _TEXT, "", "operating system and its release"),
    ColumnSpec("versions", _TEXT, "", "versions of Python and the libraries, as JSON"),
    ColumnSpec("commit", _TEXT, "", "commit of the code, with -dirty where files differed from it"),
    ColumnSpec("code", _TEXT, "", "hash of all sources that the run depends on: rows made by other code differ"),
    ColumnSpec("own", _TEXT, "", "somebody's own code in the run: names, modules, versions, as JSON; null without"),
    ColumnSpec("started", _TEXT, "", "when the run started, UTC, ISO 8601"),
)


def build_schema(columns: Iterable[ColumnSpec]) -> pa.Schema:
    """Build the Arrow schema of columns, in their order."""
    return pa.schema([pa.field(c.name, c.type) for c in columns])


RUN_SCHEMA = build_schema(RUN_COLUMNS)

_COLUMN_BY_NAME = {column.name: column for column in RUN_COLUMNS}


def select_run_columns(*names: str) -> tuple[ColumnSpec, ...]:
    """Return columns that have the same definition as in the rows of runs."""
    return tuple(_COLUMN_BY_NAME[name] for name in names)


SOLVER_COLUMN_SPECS = select_run_columns("family", "reference", "minimises", "own_steps")
"""Metadata of a solver."""

PROVENANCE_COLUMN_SPECS = select_run_columns(
    *("machine", "node", "cpu", "cores", "memory_gib", "system", "versions", "commit", "code", "started"),
)
"""Machine, time and code version of a measurement."""
