"""Columns of the rows of a run: `COLUMNS` is both their schema and their documentation.

`results/README.md` shows the same table.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import pyarrow as pa


class Column(NamedTuple):
    """One column: name, Arrow type, unit ("" if dimensionless) and description."""

    name: str
    type: pa.DataType
    unit: str
    meaning: str


_TEXT, _INT, _REAL = pa.string(), pa.int64(), pa.float64()

COLUMNS = (
    Column("run_id", _TEXT, "", "hash of all that determines the run's result and timing"),
    Column("sweep", _TEXT, "", "name of the sweep, the stem of its file"),
    Column("scene", _TEXT, "", "name of the scene, the stem of its file"),
    Column("size", _INT, "", "mesh size of the sweep; 0 where the mesh comes from a file"),
    Column("solver", _TEXT, "", "name of the solver"),
    Column("parameters", _TEXT, "", "the solver's parameters, as JSON"),
    Column("family", _TEXT, "", "what the solver has in common with others; `local-global` is the paper's method"),
    Column("reference", _TEXT, "", "where the solver's method comes from: authors, year, title and doi, as JSON"),
    Column("minimises", pa.bool_(), "", "whether the solver's iterates tend to a minimum of the step's objective"),
    Column("own_steps", pa.bool_(), "", "whether the solver integrates time in substeps of its own"),
    Column("vertices", _INT, "", "vertices of the mesh"),
    Column("springs", _INT, "", "springs of the mesh"),
    Column(
        "modulus_exponent",
        _INT,
        "",
        "power of the mesh's spacing that the material's modulus (EA, E t or E) is proportional to, by the springs' "
        "rule; 0: every size is the same material; null: no rule, or several",
    ),
    Column("time_step", _REAL, "s", "the time step dt"),
    Column("integrator", _TEXT, "", "how time is integrated, by name: implicit-euler, bdf2, midpoint, sdirk-4, ..."),
    Column(
        "first_guess", _TEXT, "", "where each step's iteration starts: assignment, current, inertial, motion or coarse"
    ),
    Column("max_iterations", _INT, "", "the iteration limit of a step"),
    Column(
        "tolerance",
        _REAL,
        "",
        "relative tolerance of the stop rule; null: all iterations are done; 0: auto",
    ),
    Column("threads", _INT, "", "threads of Numba and of BLAS"),
    Column("asked", _REAL, "", "the relative error at the end that was asked for; null: steps as they are stated"),
    Column("estimated", _REAL, "", "where one was: that error, estimated by a motion to a closer tolerance"),
    Column(
        "local_tolerance_m",
        _REAL,
        "m",
        "what each step may err by, root mean square over the free coordinates; null: steps of one length",
    ),
    Column("accepted", _INT, "", "steps that kept to it"),
    Column("rejected", _INT, "", "steps that did not, and were done again"),
    Column("factorisations", _INT, "", "factors made: one a length of steps, or one a linearly implicit step tried"),
    Column("estimate_seconds", _REAL, "s", "wall time of all that was simulated to choose and to estimate"),
    Column(
        "phase",
        _TEXT,
        "",
        "prepare, step, local, global, iteration or run (the run as a whole), and what else a solver times; of a "
        "machine its kernel",
    ),
    Column("frame", _INT, "", "the step, from 1; null where the phase has none"),
    Column("round", _INT, "", "repetition of the measurement, from 0; prepare: 0 is cold, later ones are warm"),
    Column(
        "seconds",
        _REAL,
        "s",
        "wall time of the phase; local and global: of one such step; iteration: of a whole solve next to these, over "
        "its iterations",
    ),
    Column(
        "pass_seconds", _REAL, "s", "wall time, by another clock, of all of the phase in the run; of steps in the round"
    ),
    Column("summed_seconds", _REAL, "s", "what the rows' times add up to in it"),
    Column("cpu_seconds", _REAL, "s", "CPU time of the process in it"),
    Column(
        "interrupted",
        pa.bool_(),
        "",
        "whether more than 3 % and 1 ms of it went by without computing: stopped, or others had the processor",
    ),
    Column(
        "adds_up",
        pa.bool_(),
        "",
        "of the parts of an iteration: whether they add up to one within 15 %, by the medians over the frames",
    ),
    Column("iterations", _INT, "", "iterations done in the step, for all of its unknowns"),
    Column(
        "stages", _INT, "", "unknowns of the step that were solved for, one after the other; energies are the last's"
    ),
    Column(
        "friction_rounds",
        _INT,
        "",
        "solves of the step, each with friction's normal forces from the one before; the most of its unknowns; null "
        "without friction",
    ),
    Column(
        "friction_change",
        _REAL,
        "",
        "by what part of its largest force friction would change in a further round; the largest of its unknowns",
    ),
    Column(
        "stopped",
        _TEXT,
        "",
        "what ended the step's iterations: iterations, tolerance, floor or stalled; the least welcome of its unknowns",
    ),
    Column(
        "residual",
        _REAL,
        "J^(1/2)",
        "|Q^-1 grad g|_Q over the unpinned vertices at the positions that the step's solve returned; taken in the "
        "untimed pass where the solver knows that of the iterate before alone; null where it does not minimise",
    ),
    Column(
        "last_residual",
        _REAL,
        "J^(1/2)",
        "the last one that the solve computed, by which the stop rule judged; null as the residual is",
    ),
    Column("residual_of", _TEXT, "", "the iterate that last_residual belongs to: returned, previous or none"),
    Column("within", _REAL, "J^(1/2)", "of `tolerance: auto`: the residual that was enough in the step"),
    Column("yardstick", _REAL, "J^(1/2)", "the residual at the step's start, which the tolerance refers to"),
    Column(
        "stationarity",
        _REAL,
        "",
        "where judged, and the solver minimises: |Q^-1 grad g|_Q at the answer, by the oracle, over the larger of "
        "its value at the current positions and round-off; of a step of several unknowns that of the worst",
    ),
    Column("attainable", _REAL, "", "where judged: of the stationarity, what round-off may make at the answer"),
    Column(
        "beyond",
        _REAL,
        "",
        "where judged: the stationarity of what round-off does not explain of the gradient, vertex by vertex; by this "
        "a step is graded",
    ),
    Column("minimum", pa.bool_(), "", "where judged: whether the answer curves upwards beyond round-off"),
    Column("flat", pa.bool_(), "", "where judged: whether its smallest curvature cannot be told from zero: a valley"),
    Column(
        "graded",
        _REAL,
        "",
        "in the first, middle and last frame, but for solvers with steps of their own: the stationarity by the oracle, "
        "judged or not",
    ),
    Column(
        "distance",
        _REAL,
        "",
        "where judged: largest distance of a vertex from where a run of Newton's method to round-off has it in that "
        "frame, over the size at rest of the component it belongs to; null from where that is lost",
    ),
    Column(
        "second_opinion",
        _TEXT,
        "",
        "where judged: whether the step's formulas, written once more, agree at random points: agrees, disagrees (in "
        "what, and by how much), or single opinion (effects from outside, held against themselves)",
    ),
    Column("energy_springs", _REAL, "J", "elastic energy of the springs after the step"),
    Column("energy_inertia", _REAL, "J", "inertia term of the step's objective"),
    Column("energy_force", _REAL, "J", "external forces' term of the step's objective"),
    Column("energy_pins", _REAL, "J", "pin penalty of the step's objective"),
    Column("energy_effects", _REAL, "J", "all other energies of the step's objective: bending, gas, damping and so on"),
    Column("objective", _REAL, "J", "the step's objective, the sum of all terms"),
    Column(
        "energy_gained",
        _REAL,
        "J",
        "kinetic energy and potentials after the step, less those of the start and the work of sources; at most zero "
        "where nothing makes energy",
    ),
    Column(
        "energy_available",
        _REAL,
        "J",
        "energy of the start, released potentials, work of sources, and what the load gives in one step; a larger gain "
        "is energy growth",
    ),
    Column("largest_strain", _REAL, "", "largest |length / rest length - 1| of a spring after the step"),
    Column(
        "strain_99",
        _REAL,
        "",
        "what 99 % of the springs stay below of it; the largest grows with the mesh where a single vertex bears a load",
    ),
    Column(
        "off",
        _REAL,
        "",
        "where lengths are exact: the largest error of one after the step, over the longest that is allowed",
    ),
    Column(
        "penetration",
        _REAL,
        "m",
        "how deep the deepest vertex is inside an obstacle after the step, 0 where none is; null without obstacles",
    ),
    Column(
        "intersections",
        _INT,
        "",
        "edges that pass through triangles of the mesh, or of what it may not pass through, after the step, told "
        "exactly by code that no solver shares; null where no effect sees to that",
    ),
    Column("digest", _TEXT, "", "SHA-256 of the positions after the step (float64 bytes)"),
    Column(
        "recorded",
        _TEXT,
        "",
        "SHA-256 of the positions that the recording ends with, read back from its file (float32 bytes, relative to "
        "its origin)",
    ),
    Column("nnz_system", _INT, "", "stored entries of the system matrix Q"),
    Column("nnz_factor", _INT, "", "stored entries of its triangular factor, null where the library hides it"),
    Column("nnz_hessian_factor", _INT, "", "stored entries of the triangular factor of Newton's Hessian"),
    Column("panel_bytes", _INT, "", "bytes in which the prepared factor is stored"),
    Column("flops_per_solve", _INT, "", "additions and multiplications of one global step, padding included"),
    Column("choice", _TEXT, "", "what the solver chose by itself, and why"),
    Column("device", _TEXT, "", "the device that the solver computed on, by name; null: the processor"),
    Column("device_memory_gib", _REAL, "GiB", "memory of that device"),
    Column("device_driver", _TEXT, "", "version of its driver"),
    Column("device_versions", _TEXT, "", "versions of the libraries that reach it, as JSON"),
    Column("sm_clock_mhz", _REAL, "MHz", "clock of its processors after the round; null, as the next five: not told"),
    Column("memory_clock_mhz", _REAL, "MHz", "clock of its memory then"),
    Column("power_w", _REAL, "W", "what it took then"),
    Column("power_limit_w", _REAL, "W", "what it may take"),
    Column("performance_state", _REAL, "", "its state then, 0 the fastest"),
    Column("temperature_c", _REAL, "°C", "its temperature then"),
    Column("kernel_seconds", _REAL, "s", "of the step's kernels on the device, by events on its stream"),
    Column("transfer_seconds", _REAL, "s", "of what the step brings to the device and back, by events"),
    Column("apart", _REAL, "", "how far the precision of the factor moves converged positions, in the scene's size"),
    Column("bytes", _REAL, "", "bytes that the phase touches, vectors and springs included, by count"),
    Column("flops", _REAL, "", "additions and multiplications of the phase, by count"),
    Column("working_set", _REAL, "", "bytes that the phase goes through again and again"),
    Column("load", _REAL, "", "load average over a minute when the phase was timed"),
    Column(
        "status",
        _TEXT,
        "",
        "ok, unsupported, diverged, energy-growth (without a source), disputed (by the second opinion), failed (an "
        "error, or a crash), time-limit, killed (from outside) or skipped",
    ),
    Column("reason", _TEXT, "", "why the status is not ok"),
    Column("time_limit", _REAL, "s", "wall time that the run might take; null: any"),
    Column("memory_limit", _REAL, "GiB", "memory that the run might take; null: any"),
    Column(
        "timing",
        _TEXT,
        "",
        "exclusive: timed alone on the machine; shared: on cores of its own, beside others; rough: in the pass that "
        "looks at it, beside others",
    ),
    Column("at_once", _INT, "", "how many runs may have been timed at once"),
    Column("pinned", _TEXT, "", "of shared timing: the cores' numbers"),
    Column("machine", _TEXT, "", "id of the machine: hash of its processor, cores and memory"),
    Column("node", _TEXT, "", "id of the computer among others like it: hash of its name"),
    Column("cpu", _TEXT, "", "name of the processor"),
    Column("cores", _INT, "", "cores this process may use"),
    Column("memory_gib", _REAL, "GiB", "memory of the machine"),
    Column("machine_bandwidth", _REAL, "B/s", "bytes a second that one thread reads and writes where it copies 64 MiB"),
    Column("machine_flops", _REAL, "1/s", "operations a second of one thread in a product of matrices, float64"),
    Column("machine_step", _REAL, "s", "a fixed step there: ten iterations of local-global by NumPy and SciPy"),
    Column("system", _TEXT, "", "operating system and its release"),
    Column("versions", _TEXT, "", "versions of Python and the libraries, as JSON"),
    Column("commit", _TEXT, "", "commit of the code, with -dirty where files differed from it"),
    Column("code", _TEXT, "", "hash of all sources that the run depends on: rows made by other code differ"),
    Column("own", _TEXT, "", "somebody's own code in the run: names, modules, versions, as JSON; null without"),
    Column("started", _TEXT, "", "when the run started, UTC, ISO 8601"),
)


def schema_of(columns: Iterable[Column]) -> pa.Schema:
    """Build the Arrow schema of columns, in their order."""
    return pa.schema([pa.field(c.name, c.type) for c in columns])


SCHEMA = schema_of(COLUMNS)

_BY_NAME = {column.name: column for column in COLUMNS}


def as_in_runs(*names: str) -> tuple[Column, ...]:
    """Return columns that have the same definition as in the rows of runs."""
    return tuple(_BY_NAME[name] for name in names)


OF_SOLVER = as_in_runs("family", "reference", "minimises", "own_steps")
"""Metadata of a solver."""

PROVENANCE = as_in_runs(
    *("machine", "node", "cpu", "cores", "memory_gib", "system", "versions", "commit", "code", "started"),
)
"""Machine, time and code version of a measurement."""
