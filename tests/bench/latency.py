"""Measure how long a user waits for each command.

    python -m tests.bench.latency [--repeats 5] [--only WORD ...] [--publish results/published/latency]

Each measurement is a process of its own. Its wall time counts, its processor time (user and system, with all its child
processes), and the wall time until its first output on a terminal. A table shows the medians. Commands that take
minutes are measured only where `--only` names them. A row states what was cold; bytecode and the file cache of the
system are warm unless it says otherwise.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from select import select
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import pyarrow as pa
from rich.table import Table
from springbench.harness.console import get_output_console
from springbench.harness.experiments.archive import compaction
from springbench.harness.results import parquet_rows, run_schema
from springbench.harness.results.published_set import TABLE_FILES

from tests.bench.scripted_study import describe_provenance, publish_tables

CHECKOUT = Path(__file__).resolve().parents[2]
QUICKSTART = CHECKOUT / "configs" / "quickstart.yaml"
NUM_STORED_RUNS = 3000
"""Number of runs that the query reads."""
Command = Sequence[str]


@dataclass(frozen=True, slots=True)
class LatencyRow:
    """A command that a user waits for.

    Attributes:
        description: what the user does.
        wanted_seconds: target of the measured value [s].
        command: arguments of `springbench`; or of Python, if the first is `-m`. RESULTS stands for a fresh folder.
        setup: the same commands, done once before each measurement.
        cold: what is cold.
        environment: variables of the process; FOLDER stands for an empty folder.
        is_long: whether it takes minutes.
        exit_codes: exit codes of a command that did its work.
        value_key: key of the measured value in the JSON output; the wall time if empty.
        prepare: fills the folder of results before all repeats.
        limit: what a profile shows to take most of the time, where the target is not reached.
    """

    description: str
    wanted_seconds: float
    command: Command
    setup: Sequence[Command] = ()
    cold: str = "nothing"
    environment: Mapping[str, str] | None = None
    is_long: bool = False
    exit_codes: tuple[int, ...] = (0,)
    value_key: str = ""
    prepare: Callable[[Path], None] | None = None
    limit: str = ""


def _copy_runs(results: Path) -> None:
    """Fill a folder of results with NUM_STORED_RUNS files of rows, from the runs of the quick start."""
    template = results / "quickstart" / "rows"
    files = sorted(template.glob("*.parquet"))
    target = results / "many" / "rows"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for k in range(NUM_STORED_RUNS):
        source = files[k % len(files)]
        shutil.copyfile(source, target / f"{source.stem[:-12]}{k:012x}.parquet")


def _pack_runs(results: Path) -> None:
    """Fill a folder of results as `_copy_runs` does, and pack its files into one."""
    _copy_runs(results)
    compaction.compact_results(results / "many", print)


_AGAIN = ("run", "hanging-cloth", "--size", "8", "--frames", "10", "--results", "RESULTS", "--rerun")
_AGAIN_NUMBA, _AGAIN_HYBRID = (*_AGAIN, "--solver", "numba"), (*_AGAIN, "--solver", "hybrid")
_TO_ERROR = ("run", "hanging-cloth", "--size", "17", "--error", "1e-4", "--t-end", "0.1", "--results", "RESULTS")
_CHAIN = ("run", "chain", "--size", "9", "--error", "1e-4", "--t-end", "0.5", "--results", "RESULTS")
_SWEEP = ("run", str(QUICKSTART), "--results", "RESULTS")
_QUERY = ("query", "select solver, count(*) from rows group by solver", "--results", "RESULTS")
_NO_KERNELS = {"NUMBA_CACHE_DIR": "FOLDER"}
_IN_PROCESS = ("-m", "tests.bench.latency", "--in-process")

_OF_A_RERUN = "a third imports, a third is the run with its kernels and Rerun, a quarter draws its picture"
_OF_A_FIRST_RUN = "three quarters compile kernels, on all cores; the rest is that of a warm run"

LATENCY_ROWS = {
    "sweep-again": LatencyRow(
        "the same sweep again, all of it done",
        0.7,
        _SWEEP,
        (_SWEEP,),
        limit="three quarters imports: NumPy, PyArrow, Pydantic, Typer, DuckDB, Rich; the rest reads rows",
    ),
    "again-numba": LatencyRow("--rerun of a small run, numba", 2.5, _AGAIN_NUMBA, (_AGAIN_NUMBA,), limit=_OF_A_RERUN),
    "again-hybrid": LatencyRow(
        "--rerun of a small run, hybrid", 3.5, _AGAIN_HYBRID, (_AGAIN_HYBRID,), limit=_OF_A_RERUN
    ),
    "list": LatencyRow("list", 0.3, ("list",)),
    "schema": LatencyRow("schema", 0.5, ("schema",)),
    "query": LatencyRow(
        f"query on {NUM_STORED_RUNS:,} runs in one file each, as while their sweep is running",
        0.8,
        _QUERY,
        (_SWEEP,),
        prepare=_copy_runs,
        limit="two thirds DuckDB, which opens 3,000 files one by one: 4 us for each of 123 columns",
    ),
    "query-packed": LatencyRow(
        f"the same after their sweep has ended, which packs them ({NUM_STORED_RUNS:,} runs in one file)",
        0.8,
        _QUERY,
        (_SWEEP,),
        prepare=_pack_runs,
        limit="the process that reads: half of its time imports DuckDB, PyArrow and NumPy",
    ),
    "figure": LatencyRow(
        "figure",
        1.5,
        ("figure", "timing", "RESULTS/quickstart", "-o", "RESULTS/figures"),
        (_SWEEP,),
        limit="half imports, in two processes, and reads rows; a quarter writes the PDF, a sixth composes",
    ),
    "preview": LatencyRow(
        "preview",
        1.5,
        ("preview", "hanging-cloth", "-o", "RESULTS/quickstart/preview.png"),
        (_SWEEP,),
        cold="the picture",
        limit="half imports Matplotlib and PyVista with VTK, in another process; a quarter renders",
    ),
    "error-search": LatencyRow(
        "run --error 1e-4, hanging cloth of 17",
        1.5,
        (*_TO_ERROR, "--rerun"),
        (_TO_ERROR,),
        limit="one half imports Numba, SciPy, Pydantic and Typer; a third prepares and tries ten methods",
    ),
    "recommend-chain": LatencyRow(
        "recommend, chain", 12.0, ("recommend", "chain", "--error", "1e-2", "--results", "RESULTS"), cold="results"
    ),
    "recommend-cloth": LatencyRow(
        "recommend, hanging cloth of 16",
        12.0,
        ("recommend", "hanging-cloth", "--size", "16", "--error", "1e-2", "--results", "RESULTS"),
        cold="results",
        limit="three fifths measure 58 candidates; a sixth imports, a ninth integrates the reference motion",
    ),
    "search-alone": LatencyRow(
        "the search alone, of run --error 1e-4 on the hanging cloth",
        0.2,
        (*_IN_PROCESS, "search-alone"),
        value_key="seconds",
        limit="four fifths prepare and try ten methods; the rest integrates the reference",
    ),
    "chain-motion": LatencyRow(
        "chain of 9, 0.5 s to 1e-4, the chosen motion",
        0.3e-3,
        (*_IN_PROCESS, "chain-motion"),
        value_key="seconds",
        limit="one half, before the first step, selects the compiled code and computes factors; an eighth takes steps",
    ),
    "verlet-substep": LatencyRow(
        "velocity Verlet, cloth of 17 a side, a substep",
        4e-6,
        (*_IN_PROCESS, "verlet-substep"),
        value_key="seconds",
        limit="three fifths the compiled loop over springs, whose bits are fixed; a quarter Python, once a frame",
    ),
    "overhead-share": LatencyRow(
        "share of processor time outside timed passes, 100 short runs",
        0.4,
        (*_IN_PROCESS, "overhead-share"),
        value_key="share",
        is_long=True,
        limit="half the untimed second pass and the rows of each run, half imports and first calls",
    ),
    "first-run-numba": LatencyRow(
        "first run, numba",
        8.0,
        _AGAIN_NUMBA,
        is_long=True,
        cold="compiled kernels",
        environment=_NO_KERNELS,
        limit=_OF_A_FIRST_RUN,
    ),
    "first-run-hybrid": LatencyRow(
        "first run, hybrid",
        12.0,
        _AGAIN_HYBRID,
        is_long=True,
        cold="compiled kernels",
        environment=_NO_KERNELS,
        limit=_OF_A_FIRST_RUN,
    ),
    "first-error-search": LatencyRow(
        "first run --error 1e-4, hanging cloth of 17",
        12.0,
        _TO_ERROR,
        is_long=True,
        cold="compiled kernels and results",
        environment=_NO_KERNELS,
        limit="nine tenths compile the kernels of ten methods, on all cores",
    ),
    "gates": LatencyRow(
        "the default gates",
        240.0,
        ("-m", "pytest", "-q", "tests/bench", "--benchmark-only"),
        is_long=True,
        exit_codes=(0, 1, 13),  # a gate failed, or cannot tell
    ),
    "regress": LatencyRow(
        "regress against a revision",
        180.0,
        ("regress", "--baseline", "HEAD"),
        is_long=True,
        exit_codes=(0, 1, 3),
    ),
    "setup": LatencyRow(
        "README's first command in an empty clone",
        60.0,
        (*_IN_PROCESS, "setup"),
        cold="the clone and its kernels, not the cache of packages",
        value_key="seconds",
        is_long=True,
        limit="a fifth installs, a fifth compiles kernels, two fifths run the sweep, a sixth draws",
    ),
    "tests": LatencyRow(
        "README's second command, the tests alone",
        180.0,
        ("-m", "pytest", "-q", "-n", "2", "--dist", "loadfile"),
        is_long=True,
    ),
}
"""Rows by name."""

MEASUREMENT_SCHEMA = run_schema.build_schema(
    (
        run_schema.ColumnSpec("row", pa.string(), "", "name of the row"),
        run_schema.ColumnSpec("description", pa.string(), "", "what the user does"),
        run_schema.ColumnSpec("cold", pa.string(), "", "what was cold"),
        run_schema.ColumnSpec("repeat", pa.int64(), "", "number of the measurement, from 0"),
        run_schema.ColumnSpec("limit", pa.string(), "", "what takes most of the time, by a profile"),
        run_schema.ColumnSpec("wanted_seconds", pa.float64(), "s", "target of the value"),
        run_schema.ColumnSpec("value", pa.float64(), "s", "wall time, or what the row measures"),
        run_schema.ColumnSpec("wall_seconds", pa.float64(), "s", "wall time of the process"),
        run_schema.ColumnSpec("cpu_seconds", pa.float64(), "s", "processor time of the process and its children"),
        run_schema.ColumnSpec(
            "first_output_seconds", pa.float64(), "s", "wall time until the first output on a terminal"
        ),
    )
)


def measure_command(
    command: Command, folder: Path, environment: Mapping[str, str] | None = None, exit_codes: Sequence[int] = (0,)
) -> dict[str, Any]:
    """Run a command in a process of its own, and return its times [s] and its output.

    Args:
        command: command of a row.
        folder: what RESULTS stands for.
        environment: variables of the process; FOLDER stands for a new empty folder.
        exit_codes: exit codes of a command that did its work.

    Raises:
        RuntimeError: the command ended with another exit code.
    """
    arguments = [word.replace("RESULTS", str(folder)) for word in command]
    arguments = [sys.executable, *arguments] if arguments[0] == "-m" else [_find_console_script(), *arguments]
    with TemporaryDirectory() as empty:
        variables = {key: value.replace("FOLDER", empty) for key, value in (environment or {}).items()}
        began = perf_counter()
        terminal, terminal_of_process = pty.openpty()  # progress is shown on terminals
        process = subprocess.Popen(
            arguments,
            cwd=CHECKOUT,
            env=os.environ | {"PYTHONDONTWRITEBYTECODE": ""} | variables,  # bytecode is warm after one start
            stdout=subprocess.PIPE,
            stderr=terminal_of_process,
        )
        os.close(terminal_of_process)
        assert process.stdout is not None
        first, output, shown = _read_streams(process.stdout.fileno(), terminal)
        os.close(terminal)
        _, status, used = os.wait4(process.pid, 0)  # with all children that the process has waited for
        wall = perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in exit_codes:
        text = (shown + output).decode(errors="replace")
        raise RuntimeError(f"{' '.join(arguments)} ended with exit code {process.returncode}:\n{text[-2000:]}")
    cpu = used.ru_utime + used.ru_stime
    times = {"wall_seconds": wall, "cpu_seconds": cpu, "first_output_seconds": first - began}
    return {**times, "output": output.decode(errors="replace")}


def _read_streams(pipe: int, terminal: int) -> tuple[float, bytes, bytes]:
    """Read a pipe and a terminal to their ends; return the time of the first bytes [s], and what both contained."""
    first, contents = 0.0, {pipe: b"", terminal: b""}
    still_open = set(contents)
    while still_open:
        for stream in select(still_open, (), ())[0]:
            try:
                chunk = os.read(stream, 1 << 16)
            except OSError:  # all processes closed the terminal
                chunk = b""
            first = first or perf_counter()
            contents[stream] += chunk
            if not chunk:
                still_open.discard(stream)
    return first, contents[pipe], contents[terminal]


def measure_row(name: str, repeats: int, warm: Path) -> list[dict[str, Any]]:
    """Measure a row, and return one measurement for each repeat.

    Args:
        name: name of the row.
        repeats: number of measurements.
        warm: folder of results for all rows; what the setup finds there is not done again.
    """
    row, found = LATENCY_ROWS[name], list[dict[str, Any]]()
    for command in row.setup:
        measure_command(command, warm)
    if row.prepare:
        row.prepare(warm)
    with TemporaryDirectory() as temporary:
        for repeat in range(repeats):
            folder = Path(temporary) / f"cold-{repeat}" if "results" in row.cold else warm
            folder.mkdir(exist_ok=True)
            measured = measure_command(row.command, folder, row.environment, row.exit_codes)
            output = measured.pop("output")
            value = json.loads(output.splitlines()[-1])[row.value_key] if row.value_key else measured["wall_seconds"]
            stated = {"row": name, "description": row.description, "cold": row.cold, "limit": row.limit}
            numbers = {"repeat": repeat, "wanted_seconds": row.wanted_seconds, "value": value}
            found.append(stated | numbers | measured)
    return found


def _find_console_script() -> str:
    return str(Path(sys.executable).with_name("springbench"))


def _read_error_control(results: Path) -> tuple[Path, dict[str, Any]]:
    """Return the only file of rows in a folder of results, and its row of `run --error`."""
    (path,) = results.glob("*/accuracy/*.parquet")
    rows = parquet_rows.read_rows([path], pa.schema([])).to_pylist()
    return path, next(row for row in rows if row["kind"] == "error-control")


def measure_chain_motion() -> dict[str, float]:
    """Return the wall time [s] of the motion that `run chain --error 1e-4` chooses."""
    with TemporaryDirectory() as temporary:
        measure_command(_CHAIN, Path(temporary))
        return {"seconds": _read_error_control(Path(temporary))[1]["seconds"][0]}


def measure_search() -> dict[str, float]:
    """Return the wall time [s] of the search of `run --error`, with kernels and references from an earlier one."""
    with TemporaryDirectory() as temporary:
        measure_command(_TO_ERROR, Path(temporary))
        _read_error_control(Path(temporary))[0].unlink()
        measure_command((*_TO_ERROR, "--rerun"), Path(temporary))
        return {"seconds": _read_error_control(Path(temporary))[1]["search_seconds"]}


def measure_verlet_substep() -> dict[str, float]:
    """Return the processor time [s] of a substep of velocity Verlet, the least of several motions."""
    from springbench.harness.config.config_loader import load_scene_in_process
    from springbench.harness.execution.machine_info import limit_threads
    from springbench.harness.scenes.scene_builder import build_scene
    from springbench.harness.simulation.time_loop import prepare, simulate_scene
    from springbench.solvers.methods.time_stepping.explicit_integrators import VelocityVerlet
    from springbench.solvers.model.step_problem import StopRule

    with limit_threads(1):
        scene = build_scene(
            load_scene_in_process(CHECKOUT / "configs" / "scenes" / "hanging-cloth.yaml"), 17, "substepping"
        )
        prepared = prepare(scene, VelocityVerlet())
        times = list[float]()
        for _ in range(7):
            began = process_time()
            for _ in simulate_scene(scene, prepared, StopRule(1), initial_guess="previous", frames=40):
                pass
            times.append((process_time() - began) / (40 * int(prepared.description.split()[0])))  # "37 substeps of ..."
    return {"seconds": min(times)}


def measure_overhead_share() -> dict[str, float]:
    """Return the share of the processor time of 100 short runs that is not spent in their timed passes."""
    from tests.sweep_overhead import measure_short_runs

    with TemporaryDirectory() as temporary:
        found = measure_short_runs(100, Path(temporary))
    return {"share": 1.0 - found["timed_cpu_seconds"] / found["cpu_seconds"]}


def measure_setup() -> dict[str, float]:
    """Return the wall time [s] of README's first command in an empty clone."""
    with TemporaryDirectory() as folder, TemporaryDirectory() as kernels:
        subprocess.run(["git", "clone", "-q", str(CHECKOUT), folder], check=True)
        command = "bash .ci/setup && .venv/bin/springbench run configs/quickstart.yaml"
        variables = os.environ | {"NUMBA_CACHE_DIR": kernels}
        began = perf_counter()
        subprocess.run(["bash", "-c", command], cwd=folder, env=variables, stdout=sys.stderr, check=True)
        return {"seconds": perf_counter() - began}


IN_PROCESS = {
    "setup": measure_setup,
    "search-alone": measure_search,
    "chain-motion": measure_chain_motion,
    "verlet-substep": measure_verlet_substep,
    "overhead-share": measure_overhead_share,
}


def print_medians(measurements: Sequence[Mapping[str, Any]]) -> None:
    """Print the medians of each row."""
    table = Table("row", "cold", "target", "value", "wall s", "processor s", "first output s")
    for name in dict.fromkeys(one["row"] for one in measurements):
        some = [one for one in measurements if one["row"] == name]
        middle = {key: median(one[key] for one in some) for key in _NUMBERS}
        table.add_row(name, some[0]["cold"], f"{some[0]['wanted_seconds']:.3g}", *(f"{v:.3g}" for v in middle.values()))
    get_output_console().print(table)


_NUMBERS = ("value", "wall_seconds", "cpu_seconds", "first_output_seconds")


def publish_measurements(measurements: Sequence[Mapping[str, Any]], folder: Path, begin: Mapping[str, Any]) -> None:
    """Write the measurements as a published study; rows that were not measured now stay as they were."""
    path = folder / TABLE_FILES["measurements"]
    known = parquet_rows.read_rows([path], MEASUREMENT_SCHEMA).to_pylist() if path.exists() else []
    now = {one["row"] for one in measurements}
    earlier = [one for one in known if one["row"] not in now and one["row"] in LATENCY_ROWS]
    stated = [{**one, "limit": LATENCY_ROWS[one["row"]].limit} for one in (*earlier, *measurements)]
    rows = sorted(stated, key=lambda one: (list(LATENCY_ROWS).index(one["row"]), one["repeat"]))
    table = pa.Table.from_pylist([dict(one) for one in rows], MEASUREMENT_SCHEMA)
    publish_tables(
        folder,
        QUICKSTART,
        "python -m tests.bench.latency",
        {"measurements": table},
        [begin, describe_provenance()],
        has_earlier_rows=bool(earlier),
    )


def main() -> None:
    """Measure the rows that the arguments name."""
    parser = argparse.ArgumentParser(description="Measure how long a user waits for each command.")
    parser.add_argument("--repeats", type=int, default=5, help="measurements of a row")
    parser.add_argument("--only", nargs="*", choices=LATENCY_ROWS, metavar="ROW", help=", ".join(LATENCY_ROWS))
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    parser.add_argument("--results", type=Path, help="results of an earlier call, which the setup does not repeat")
    parser.add_argument("--in-process", choices=IN_PROCESS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.in_process:
        print(json.dumps(IN_PROCESS[options.in_process]()))
        return
    names = options.only or [name for name, row in LATENCY_ROWS.items() if not row.is_long]
    measurements, begin = list[dict[str, Any]](), describe_provenance()
    with TemporaryDirectory() as temporary:
        warm = (options.results or Path(temporary)).resolve()
        for number, name in enumerate(names):
            print(f"[{number + 1}/{len(names)}] {name}: {LATENCY_ROWS[name].description}", file=sys.stderr, flush=True)
            measurements += measure_row(name, options.repeats, warm)
            if options.publish:
                publish_measurements(measurements, options.publish, begin)
    print_medians(measurements)


if __name__ == "__main__":
    main()
