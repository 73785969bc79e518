"""Measure local-global compiled by Numba, in three precisions, compared with two programs in C++.

    python -m tests.bench.cpp_programs [--sizes 10 32 64 128] [--rounds 15] [--publish results/published/cpp-programs]

Each program solves the first step of `configs/scenes/yardstick-cloth.yaml` in fifty iterations. All run interleaved in
one process on one thread. The table has the median processor time of an iteration. `eigen` is the program of the
assignment, with Eigen's SimplicialLLT; `cholmod` is an optimised program, with the factorisation of CHOLMOD. Both
require a C++ compiler and their libraries (Debian: libeigen3-dev, libsuitesparse-dev). `springbench roofline
configs/speed.yaml` compares larger meshes and the limits of the machine, by wall time on an idle machine.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median
from time import thread_time
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare
from springbench.solvers.model.step_problem import Solver, StopRule
from springbench.solvers.registry import OPTIONAL_SOLVERS, SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

SCENE = Path(__file__).parents[2] / "configs" / "scenes" / "yardstick-cloth.yaml"
PROGRAMS: dict[str, Solver] = {
    **{f"numba {one}": load_target(SOLVERS["numba"])(precision=one) for one in ("float64", "float32", "float16")},
    **{name: load_target(OPTIONAL_SOLVERS[name])() for name in ("eigen", "cholmod")},
}
STOP = StopRule(50)


def measure_size(size: int, num_rounds: int) -> list[dict[str, Any]]:
    """Measure a mesh size: a row for each program and each round after the warm-up."""
    scene = build_scene(load_scene(SCENE), size)
    problem = build_problem(scene, build_initial_state(scene), "previous")
    prepared = {name: prepare(scene, solver) for name, solver in PROGRAMS.items()}
    rows = list[dict[str, Any]]()
    for number in range(-1, num_rounds):  # the first compiles
        for name, solver in prepared.items():
            began = thread_time()
            solver.solve(problem, STOP)
            rows.append({"size": size, "program": name, "round": number, "cpu_seconds": thread_time() - began})
    return [row for row in rows if row["round"] >= 0]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 32, 64, 128])
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    table = Table("a side", *(f"{name}, µs an iteration" for name in PROGRAMS), box=SIMPLE_HEAD)
    with limit_threads(1):
        for size in options.sizes:
            found = measure_size(size, options.rounds)
            times = [median(row["cpu_seconds"] for row in found if row["program"] == name) for name in PROGRAMS]
            table.add_row(str(size), *(f"{1e6 * seconds / STOP.max_iterations:.3g}" for seconds in times))
            rows += found
    Console(width=120).print(table)
    publish_rows(options.publish, SCENE, rows, begin)


if __name__ == "__main__":
    main()
