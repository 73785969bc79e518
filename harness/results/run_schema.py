"""Columns of the rows of a run: `RUN_COLUMNS` is both their schema and their documentation.

`springbench reference` writes the same table to `configs/reference/columns.md`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import pyarrow as pa
from springbench.harness.execution.pandas_deferral import defer_pandas

defer_pandas()


class ColumnSpec(NamedTuple):
    """One column: name, Arrow type, unit ("" if dimensionless) and description."""

    name: str
    type: pa.DataType
    unit: str
    description: str


_TEXT, _INT, _REAL = pa.string(), pa.int64(), pa.float64()

RUN_COLUMNS = (
    ColumnSpec("run_id", _TEXT, "", "hash of everything that determines the run's result and timing"),
    ColumnSpec("sweep", _TEXT, "", "name of the sweep, the stem of its file"),
    ColumnSpec("scene", _TEXT, "", "name of the scene, the stem of its file"),
    ColumnSpec("size", _INT, "", "mesh size of the sweep; 0 if the mesh is from a file"),
    ColumnSpec("solver", _TEXT, "", "name of the solver"),
    ColumnSpec("parameters", _TEXT, "", "parameters of the solver, as JSON"),
    ColumnSpec("family", _TEXT, "", "family of methods; `local-global` is the paper's method"),
    ColumnSpec("citation", _TEXT, "", "source of the method: authors, year, title and doi, as JSON"),
    ColumnSpec("is_minimiser", pa.bool_(), "", "whether the iterates tend to a minimum of the step's objective"),
    ColumnSpec("is_substepping", pa.bool_(), "", "whether the solver integrates time in substeps of its own"),
    ColumnSpec("vertices", _INT, "", "number of vertices of the mesh"),
    ColumnSpec("springs", _INT, "", "number of springs of the mesh"),
    ColumnSpec(
        "modulus_exponent",
        _INT,
        "",
        "exponent of the mesh spacing to which the material's modulus (EA, E t or E) is proportional by the "
        "springs' scaling rule; 0: the same material at every size; null: no rule, or several",
    ),
    ColumnSpec("time_step", _REAL, "s", "time step dt"),
    ColumnSpec("integrator", _TEXT, "", "time integrator: implicit-euler, bdf2, midpoint, sdirk-4, ..."),
    ColumnSpec(
        "initial_guess",
        _TEXT,
        "",
        "initial guess of each step's iteration: assignment, previous, inertial, extrapolated or coarse-to-fine",
    ),
    ColumnSpec("max_iterations", _INT, "", "iteration limit of a step"),
    ColumnSpec(
        "residual_rtol",
        _REAL,
        "",
        "relative tolerance of the residual in the stop rule; null: all iterations are performed; 0: auto",
    ),
    ColumnSpec("threads", _INT, "", "threads of Numba and of BLAS"),
    ColumnSpec(
        "error_requested",
        _REAL,
        "",
        "requested relative error of the final positions; null: the given steps are used",
    ),
    ColumnSpec(
        "error_estimated",
        _REAL,
        "",
        "with a requested error: estimate of that error from a run with a tighter tolerance",
    ),
    ColumnSpec(
        "step_atol_m",
        _REAL,
        "m",
        "absolute tolerance of a step's local error, root mean square over the free coordinates; null: fixed step size",
    ),
    ColumnSpec("num_accepted_steps", _INT, "", "steps whose estimated error is within the tolerance"),
    ColumnSpec("num_rejected_steps", _INT, "", "steps that were repeated with a smaller size"),
    ColumnSpec(
        "num_factorisations",
        _INT,
        "",
        "matrix factorisations: one per step size, or one per attempted linearly implicit step",
    ),
    ColumnSpec(
        "search_seconds",
        _REAL,
        "s",
        "wall time of all simulations that select the method and estimate its error",
    ),
    ColumnSpec(
        "phase",
        _TEXT,
        "",
        "timed phase: prepare, step, local, global, iteration, run (the run as a whole), or another phase of "
        "the solver; for a machine its microbenchmark",
    ),
    ColumnSpec("frame", _INT, "", "step, from 1; null for phases outside steps"),
    ColumnSpec(
        "round",
        _INT,
        "",
        "repetition of the measurement, from 0; prepare: 0 is the first call, later rounds are warm",
    ),
    ColumnSpec(
        "seconds",
        _REAL,
        "s",
        "wall time of the phase; local, global: of one such step; iteration: of a whole solve, measured next "
        "to them, divided by its iterations",
    ),
    ColumnSpec(
        "wall_seconds_check",
        _REAL,
        "s",
        "wall time of all calls of the phase by another clock: in the run, for steps in the round",
    ),
    ColumnSpec("wall_seconds_sum", _REAL, "s", "sum of the rows' times in the same interval"),
    ColumnSpec("cpu_seconds", _REAL, "s", "CPU time of the process in the same interval"),
    ColumnSpec(
        "preempted",
        pa.bool_(),
        "",
        "whether more than 3 % and 1 ms of that interval passed without computing: the process was suspended "
        "or preempted",
    ),
    ColumnSpec(
        "phases_consistent",
        pa.bool_(),
        "",
        "for phases of an iteration: whether their medians over the frames sum to that of an iteration within 15 %",
    ),
    ColumnSpec("num_iterations", _INT, "", "iterations of the step, over all of its stages"),
    ColumnSpec(
        "num_stages",
        _INT,
        "",
        "stages of the step, solved one after the other; energies are those of the last",
    ),
    ColumnSpec(
        "friction_iterations",
        _INT,
        "",
        "solves of the step, each with the normal forces of the previous one; maximum over its stages; null "
        "without friction",
    ),
    ColumnSpec(
        "friction_relative_change",
        _REAL,
        "",
        "change of friction in one more iteration, relative to its largest force; maximum over the stages",
    ),
    ColumnSpec(
        "termination_reason",
        _TEXT,
        "",
        "why the step's iteration ended: max-iter, saddle, stalled, converged or roundoff; the least favourable of its "
        "stages",
    ),
    ColumnSpec(
        "solver_phases",
        _TEXT,
        "",
        "methods that the solver switched between in the step, each with its iterations, its time and its share of the "
        "cost; the time is the processor time of the solving thread in the untimed pass, from the start of the method "
        "to that of the next one, checks included; the cost is counted in operations, and decides which method "
        "continues; `lbfgs` includes the sweeps between its iterations; null for a solver of one method",
    ),
    ColumnSpec(
        "residual",
        _REAL,
        "J^(1/2)",
        "|Q^-1 grad g|_Q over the unpinned vertices at the returned positions; from the untimed pass if the "
        "solver computes only that of the previous iterate; null if it does not minimise",
    ),
    ColumnSpec(
        "residual_last",
        _REAL,
        "J^(1/2)",
        "last residual that the solve computed and the stop rule tested; null where residual is",
    ),
    ColumnSpec("residual_iterate", _TEXT, "", "iterate of residual_last: returned, previous or none"),
    ColumnSpec(
        "residual_atol",
        _REAL,
        "J^(1/2)",
        "with the tolerance `auto`: absolute tolerance of the residual in the step",
    ),
    ColumnSpec(
        "residual_initial",
        _REAL,
        "J^(1/2)",
        "residual at the start of the step, to which residual_rtol refers",
    ),
    ColumnSpec(
        "stationarity",
        _REAL,
        "",
        "verified runs of a minimiser: |Q^-1 grad g|_Q at the solution, by the reference evaluator, over the "
        "larger of its value at the current positions and round-off; the largest of the stages",
    ),
    ColumnSpec(
        "stationarity_roundoff_bound",
        _REAL,
        "",
        "verified runs: part of the stationarity that round-off can cause at the solution",
    ),
    ColumnSpec(
        "stationarity_above_roundoff",
        _REAL,
        "",
        "verified runs: stationarity of the part of the gradient that round-off does not explain, vertex by "
        "vertex; it decides whether a step is correct",
    ),
    ColumnSpec(
        "is_local_minimum",
        pa.bool_(),
        "",
        "verified runs: whether the Hessian at the solution is positive definite beyond round-off",
    ),
    ColumnSpec(
        "is_degenerate",
        pa.bool_(),
        "",
        "verified runs: whether the smallest eigenvalue of that Hessian is zero within round-off",
    ),
    ColumnSpec(
        "stationarity_audit",
        _REAL,
        "",
        "in the first, middle and last frame, except of substepping solvers: stationarity by the reference "
        "evaluator, also of runs that are not verified",
    ),
    ColumnSpec(
        "reference_distance",
        _REAL,
        "",
        "verified runs: largest distance of a vertex from the reference solution (Newton's method to "
        "round-off) in that frame, over the rest size of its connected component; null once the reference is "
        "lost",
    ),
    ColumnSpec(
        "formula_check",
        _TEXT,
        "",
        "verified runs: how the energies are checked: release (all are shipped; tests of each release compare them "
        "with independently written formulas) or gradient (those from user code, by class: each gradient against the "
        "derivative of its energy's value at random points)",
    ),
    ColumnSpec("energy_springs", _REAL, "J", "elastic energy of the springs after the step"),
    ColumnSpec("energy_inertia", _REAL, "J", "inertia term of the step's objective"),
    ColumnSpec("energy_force", _REAL, "J", "term of external forces in the step's objective"),
    ColumnSpec("energy_pins", _REAL, "J", "pin penalty in the step's objective"),
    ColumnSpec(
        "energy_effects",
        _REAL,
        "J",
        "all other energies of the step's objective: bending, gas, damping and so on",
    ),
    ColumnSpec("objective", _REAL, "J", "objective of the step, the sum of all terms"),
    ColumnSpec(
        "energy_gain",
        _REAL,
        "J",
        "kinetic energy and potentials after the step, minus those of the start and the work of sources; at "
        "most zero if nothing adds energy",
    ),
    ColumnSpec(
        "energy_available",
        _REAL,
        "J",
        "energy of the start, released potentials, work of sources, and what the load gives in one step; a "
        "larger gain is energy growth",
    ),
    ColumnSpec("kinetic_energy", _REAL, "J", "kinetic energy after the step of all vertices without an exact pin"),
    ColumnSpec(
        "potential_energy",
        _REAL,
        "J",
        "springs, loads, penalty pins and all other potentials after the step, loads relative to the start",
    ),
    ColumnSpec(
        "provided_energy",
        _REAL,
        "J",
        "energy of the start, released by loads, and positive work of sources, up to the end of the step",
    ),
    ColumnSpec(
        "source_work",
        _REAL,
        "J",
        "work in the step of changing forces, moving pins and obstacles, and energies whose parameters change",
    ),
    ColumnSpec(
        "dissipation_damping",
        _REAL,
        "J",
        "energy that damping effects dissipated in the step; in frames that the solver integrates itself, integrated "
        "along the motion interpolated between their ends",
    ),
    ColumnSpec("dissipation_friction", _REAL, "J", "energy that friction dissipated in the step"),
    ColumnSpec(
        "dissipation_integrator",
        _REAL,
        "J",
        "energy that the time integrator dissipated in the step beyond what the scene does; negative: it added energy; "
        "null where `dissipation_engine` is not",
    ),
    ColumnSpec(
        "dissipation_solve",
        _REAL,
        "J",
        "energy dissipated by the unconverged solve: minus the work of the residual force; negative: it added energy; "
        "null where the solver integrates frames itself",
    ),
    ColumnSpec(
        "dissipation_engine",
        _REAL,
        "J",
        "energy that an engine dissipated in the frame by its integrator and its solves, which the positions and "
        "velocities of frames cannot separate; null for other solvers",
    ),
    ColumnSpec(
        "balance_error",
        _REAL,
        "J",
        "change of the energy in the step that these terms do not explain: round-off; in frames that the solver "
        "integrates itself, the estimated error of source_work and dissipation_damping by quadrature",
    ),
    ColumnSpec("max_strain", _REAL, "", "maximum over the springs of |length / rest length - 1| after the step"),
    ColumnSpec(
        "strain_p99",
        _REAL,
        "",
        "99th percentile of the same; the maximum grows with the mesh where a single vertex bears a load",
    ),
    ColumnSpec(
        "max_length_error",
        _REAL,
        "",
        "with inextensible springs: maximum error of a length after the step, over the largest allowed length",
    ),
    ColumnSpec(
        "penetration_depth",
        _REAL,
        "m",
        "depth of the deepest vertex inside an obstacle after the step, 0 if none is inside; null without obstacles",
    ),
    ColumnSpec(
        "num_intersections",
        _INT,
        "",
        "edges that intersect triangles of the mesh or of obstacles after the step, by an exact test that no "
        "solver shares; null without contact that prevents it",
    ),
    ColumnSpec("positions_digest", _TEXT, "", "SHA-256 of the positions after the step (float64 bytes)"),
    ColumnSpec(
        "recording_digest",
        _TEXT,
        "",
        "SHA-256 of the last positions in the recording, read back from its file (float32 bytes, relative to "
        "its origin)",
    ),
    ColumnSpec("nnz_system", _INT, "", "stored entries of the system matrix Q"),
    ColumnSpec("nnz_factor", _INT, "", "stored entries of its triangular factor; null if the library hides it"),
    ColumnSpec("nnz_hessian_factor", _INT, "", "stored entries of the triangular factor of Newton's Hessian"),
    ColumnSpec("factor_bytes", _INT, "", "bytes of the stored factor"),
    ColumnSpec("flops_per_solve", _INT, "", "floating-point operations of one global step, padding included"),
    ColumnSpec("solver_description", _TEXT, "", "automatic choices of the solver and their reasons"),
    ColumnSpec("device", _TEXT, "", "name of the device of the solver; null: the CPU"),
    ColumnSpec("device_memory_gib", _REAL, "GiB", "memory of that device"),
    ColumnSpec("device_driver", _TEXT, "", "version of its driver"),
    ColumnSpec("device_versions", _TEXT, "", "versions of the libraries for the device, as JSON"),
    ColumnSpec(
        "sm_clock_mhz",
        _REAL,
        "MHz",
        "clock of the device's processors after the round; null, like the next five, if unknown",
    ),
    ColumnSpec("memory_clock_mhz", _REAL, "MHz", "clock of its memory at that time"),
    ColumnSpec("power_w", _REAL, "W", "its power draw at that time"),
    ColumnSpec("power_limit_w", _REAL, "W", "its power limit"),
    ColumnSpec("performance_state", _REAL, "", "its performance state at that time, 0 is the fastest"),
    ColumnSpec("temperature_c", _REAL, "°C", "its temperature at that time"),
    ColumnSpec("kernel_seconds", _REAL, "s", "time of the step's kernels on the device, by events on its stream"),
    ColumnSpec("transfer_seconds", _REAL, "s", "time of the step's transfers to the device and back, by events"),
    ColumnSpec(
        "precision_error",
        _REAL,
        "",
        "displacement of converged positions by the precision of the factor, relative to the scene's size",
    ),
    ColumnSpec(
        "bytes_moved",
        _REAL,
        "",
        "bytes that the phase reads and writes, vectors and springs included, by count",
    ),
    ColumnSpec("flops", _REAL, "", "floating-point operations of the phase, by count"),
    ColumnSpec("working_set_bytes", _REAL, "", "bytes that the phase accesses repeatedly"),
    ColumnSpec("load_average", _REAL, "", "load average over a minute when the phase was timed"),
    ColumnSpec(
        "status",
        _TEXT,
        "",
        "ok, unsupported, diverged, energy-growth (without a source), wrong-gradient (see formula_check), failed (an "
        "error or a crash), time-limit, killed (from outside) or skipped",
    ),
    ColumnSpec("reason", _TEXT, "", "why the status is not ok"),
    ColumnSpec("time_limit", _REAL, "s", "limit of the run's wall time; null: none"),
    ColumnSpec("memory_limit", _REAL, "GiB", "limit of the run's memory; null: none"),
    ColumnSpec(
        "timing",
        _TEXT,
        "",
        "exclusive: timed alone on the machine; shared: on cores of its own, concurrently with others; none: "
        "in the instrumentation pass, concurrently with others",
    ),
    ColumnSpec("num_concurrent_runs", _INT, "", "maximum number of runs timed concurrently"),
    ColumnSpec("pinned_cores", _TEXT, "", "with shared timing: the numbers of the cores"),
    ColumnSpec("machine_id", _TEXT, "", "id of the machine model: hash of its processor, cores and memory"),
    ColumnSpec("node_id", _TEXT, "", "id of the computer among those of one model: hash of its name"),
    ColumnSpec("cpu", _TEXT, "", "name of the processor"),
    ColumnSpec("cores", _INT, "", "cores available to the process"),
    ColumnSpec("memory_gib", _REAL, "GiB", "memory of the machine"),
    ColumnSpec(
        "machine_bandwidth",
        _REAL,
        "B/s",
        "memory bandwidth of one thread that copies 64 MiB, reads and writes",
    ),
    ColumnSpec(
        "machine_flops_per_second",
        _REAL,
        "1/s",
        "floating-point rate of one thread in a matrix product, float64",
    ),
    ColumnSpec(
        "machine_step_seconds",
        _REAL,
        "s",
        "time of a fixed step on the machine: ten iterations of local-global with NumPy and SciPy",
    ),
    ColumnSpec("operating_system", _TEXT, "", "operating system and its release"),
    ColumnSpec("versions", _TEXT, "", "versions of Python and the libraries, as JSON"),
    ColumnSpec("commit", _TEXT, "", "commit of the code, with -dirty if files differed from it"),
    ColumnSpec(
        "source_fingerprint",
        _TEXT,
        "",
        "hash of all sources that the run depends on; rows of other code have another one",
    ),
    ColumnSpec("plugins", _TEXT, "", "user code in the run: names, modules, versions, as JSON; null without"),
    ColumnSpec("started_at", _TEXT, "", "start of the run, UTC, ISO 8601"),
)


def build_schema(columns: Iterable[ColumnSpec]) -> pa.Schema:
    """Build the Arrow schema of columns, in their order."""
    return pa.schema([pa.field(c.name, c.type) for c in columns])


RUN_SCHEMA = build_schema(RUN_COLUMNS)

_COLUMN_BY_NAME = {column.name: column for column in RUN_COLUMNS}


def select_run_columns(*names: str) -> tuple[ColumnSpec, ...]:
    """Return columns that have the same definition as in the rows of runs."""
    return tuple(_COLUMN_BY_NAME[name] for name in names)


SOLVER_COLUMN_SPECS = select_run_columns("family", "citation", "is_minimiser", "is_substepping")
"""Metadata of a solver."""

PROVENANCE_COLUMN_SPECS = select_run_columns(
    *(
        "machine_id",
        "node_id",
        "cpu",
        "cores",
        "memory_gib",
        "operating_system",
        "versions",
        "commit",
        "source_fingerprint",
        "started_at",
    ),
)
"""Machine, time and code version of a measurement."""
