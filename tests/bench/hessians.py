"""Measure the treatments of indefinite Hessians in Newton's method: iterations, examined elements, and CPU time.

    python -m tests.bench.hessians [SCENE ...] [--repeats 3] [--publish results/published/hessians]

The scenes are those of `configs/hessians.yaml`, with its limits. The rules alternate frame by frame in one process. A
cell has the iterations of a rule, the share of elements whose Hessians it examines, and its CPU time. The share is
relative to all elements in all iterations, which `clamp` examines. The CPU time is relative to that of the default rule
without preparation, the median over the repeats. The mark > denotes a rule that reaches the iteration limit in a frame.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import SimulationStep, prepare, simulate_scene
from springbench.solvers.methods.newton import hessian_regularisation
from springbench.solvers.methods.newton.hessian_regularisation import IndefiniteStrategy
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.objective.psd_projection import ProjectedHessian, PsdProjection
from springbench.solvers.objective.step_objective import Hessian

from tests.bench.scripted_study import describe_provenance, publish_rows

CONFIG = Path(__file__).parents[2] / "configs" / "hessians.yaml"
SCENES = sorted((CONFIG.parent / "hessians").glob("*.yaml"))
STOP = StopRule(1000, 1e-6)
RULES: tuple[IndefiniteStrategy, ...] = tuple(hessian_regularisation.REGULARISATION_RULES)


@dataclass
class Tally:
    """Work of a rule on a scene.

    seconds: CPU time [s]; elements: in all iterations; examined: elements that the rule examined; is_converged: whether
    no frame reached the iteration limit.
    """

    iterations: int = 0
    seconds: float = 0.0
    elements: int = 0
    examined: int = 0
    is_converged: bool = True


@contextmanager
def count_examined_elements() -> Iterator[list[int]]:
    """Yield a list that gains the number of elements that each projected Hessian examines."""
    examined: list[int] = []
    project_to_psd = Hessian.project_to_psd

    def project_and_count(self: Hessian, projection: PsdProjection) -> ProjectedHessian:
        found = project_to_psd(self, projection)
        examined.append(found.num_examined)
        return found

    with patch.object(Hessian, "project_to_psd", project_and_count):
        yield examined


def measure_strategies(path: Path) -> dict[IndefiniteStrategy, Tally]:
    """Simulate a scene by each rule, and return the work of each."""
    spec = load_scene(path)
    made = build_scene(spec, spec.default_size or 0)
    edges = sum(len(getattr(energy, "edges", ())) for energy in made.system.energies)
    tallies: dict[IndefiniteStrategy, Tally] = {rule: Tally() for rule in RULES}
    runs: dict[IndefiniteStrategy, Iterator[SimulationStep]] = {
        rule: simulate_scene(
            made, prepare(made, NewtonSolver(rule)), STOP, initial_guess="previous", frames=spec.frames
        )
        for rule in RULES
    }
    for _ in range(spec.frames):
        for rule, run in runs.items():
            tally = tallies[rule]
            with count_examined_elements() as examined:
                began = time.process_time()
                solution = next(run).solution
                tally.seconds += time.process_time() - began
            tally.examined += sum(examined)
            tally.iterations += solution.num_iterations
            tally.elements += solution.num_iterations * edges
            tally.is_converged &= solution.termination_reason != "max-iter"
    return tallies


def list_rows(path: Path, repeat: int) -> list[dict[str, Any]]:
    """Return the measurements of a scene, one row for each rule."""
    return [
        {
            "scene": path.stem,
            "strategy": rule,
            "repeat": repeat,
            "num_iterations": tally.iterations,
            "is_converged": tally.is_converged,
            "examined_share": tally.examined / tally.elements,
            "cpu_seconds": tally.seconds,
        }
        for rule, tally in measure_strategies(path).items()
    ]


def format_cells(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the cells of a scene: iterations, share of examined elements, and ratio of times."""
    default = {row["repeat"]: row["cpu_seconds"] for row in rows if row["strategy"] == "shift-schedule"}
    for rule in RULES:
        own = [row for row in rows if row["strategy"] == rule]
        ratio = median(row["cpu_seconds"] / default[row["repeat"]] for row in own)
        share = f" {100 * own[0]['examined_share']:.0f} %" if own[0]["examined_share"] else ""
        yield f"{'' if own[0]['is_converged'] else '>'}{own[0]['num_iterations']}{share} {ratio:.2f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="*", type=Path, default=SCENES, metavar="SCENE")
    parser.add_argument("--repeats", type=int, default=3, help="measurements of each scene")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    table, begin, rows = Table("scene", *RULES, box=SIMPLE_HEAD), describe_provenance(), list[dict[str, Any]]()
    with limit_threads(1):
        measure_strategies(options.scenes[0])  # compiles
        for path in options.scenes:
            found = [row for repeat in range(options.repeats) for row in list_rows(path, repeat)]
            table.add_row(path.stem, *format_cells(found))
            rows += found
    Console(width=120).print(table)
    publish_rows(options.publish, CONFIG, rows, begin)


if __name__ == "__main__":
    main()
