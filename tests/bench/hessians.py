"""What Newton's method does about indefinite Hessians: iterations, elements looked at, and CPU time of each rule.

    python -m tests.bench.hessians [SCENE ...]

The scenes of `configs/hessians.yaml`, with its limits. Rules take turns, frame by frame, in one process. Elements that
were looked at are stated as a part of all elements in all iterations, which `clamp` looks at; CPU time as a multiple of
that of the default, without what it takes to prepare. A rule that needs all iterations in some frame is marked by >.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
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

SCENES = sorted((Path(__file__).parents[2] / "configs" / "hessians").glob("*.yaml"))
STOP = StopRule(1000, 1e-6)
RULES: tuple[IndefiniteStrategy, ...] = tuple(hessian_regularisation.REGULARISATION_RULES)


@dataclass
class Tally:
    """What a rule took of a scene. elements: all of them in all iterations; looked: those that were looked at."""

    iterations: int = 0
    seconds: float = 0.0
    elements: int = 0
    looked: int = 0
    ended: bool = True

    def format_counts(self, against: Tally) -> str:
        """The cell."""
        looked = f" {100 * self.looked / self.elements:.0f} %" if self.looked else ""
        return f"{'' if self.ended else '>'}{self.iterations}{looked} {self.seconds / against.seconds:.2f}"


@contextmanager
def counted() -> Iterator[list[int]]:
    """How many elements each filtered Hessian looked at, from now on."""
    looked: list[int] = []
    filtered = Hessian.project_to_psd

    def counting(self: Hessian, by: PsdProjection) -> ProjectedHessian:
        found = filtered(self, by)
        looked.append(found.num_examined)
        return found

    with patch.object(Hessian, "project_to_psd", counting):
        yield looked


def measured(path: Path) -> dict[IndefiniteStrategy, Tally]:
    """A scene by each rule."""
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
            with counted() as looked:
                began = time.process_time()
                solution = next(run).solution
                tally.seconds += time.process_time() - began
            tally.looked += sum(looked)
            tally.iterations += solution.num_iterations
            tally.elements += solution.num_iterations * edges
            tally.ended &= solution.termination_reason != "max-iter"
    return tallies


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="*", type=Path, default=SCENES, metavar="SCENE")
    table = Table("scene", *RULES, box=SIMPLE_HEAD)
    scenes = parser.parse_args().scenes
    with limit_threads(1):
        measured(scenes[0])  # compiles
        for path in scenes:
            found = measured(path)
            table.add_row(path.stem, *(tally.format_counts(found["shift-schedule"]) for tally in found.values()))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
