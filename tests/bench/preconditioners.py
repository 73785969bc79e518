"""Count iterations and products with the Hessian of conjugate gradients by preconditioner.

    python -m tests.bench.preconditioners [SCENE ...] [--publish results/published/preconditioners]

Scenes of `configs/hessians` are simulated to residuals of 1e-6 by `newton-cg` and `pncg`. A cell has the number of
iterations and, for `newton-cg`, the number of products with the Hessian, which take most of the time without the
preconditioner. The mark > denotes a solver that does not converge in all steps. All counts are exact.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, get_args
from unittest.mock import patch

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.iteration.preconditioners import PreconditionerName
from springbench.solvers.methods.newton import newton_cg
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.quasi_newton.nonlinear_cg import NonlinearCG
from springbench.solvers.model.step_problem import Positions, Solver, StopRule
from springbench.solvers.objective.step_objective import Hessian

from tests.bench.scripted_study import describe_provenance, publish_rows

CONFIG = Path(__file__).parents[2] / "configs" / "hessians.yaml"
SCENES = tuple(CONFIG.with_suffix("") / f"{name}-pressed-0.yaml" for name in ("block", "cloth-100", "cloth-1e4"))
STOP = StopRule(5000, 1e-6)
NAMES: tuple[PreconditionerName, ...] = get_args(PreconditionerName)


SOLVERS: dict[str, type[NewtonCG] | type[NonlinearCG]] = {"newton-cg": NewtonCG, "pncg": NonlinearCG}


def count_work(path: Path, solver: Solver) -> dict[str, Any]:
    """Count the iterations of a solver on a scene, and its products with the Hessian."""
    spec = load_scene(path)
    made = build_scene(spec, spec.default_size or 0)
    products, multiply = [0], Hessian.matvec

    def count_and_multiply(self: Hessian, x: Positions) -> Positions:
        products[0] += 1
        return multiply(self, x)

    iterations, is_converged = 0, True
    with (
        patch.object(Hessian, "matvec", count_and_multiply),
        patch.object(newton_cg, "_compiled_factor", lambda metric: None),
    ):
        for step in simulate_scene(made, prepare(made, solver), STOP, initial_guess="previous", frames=spec.frames):
            iterations += step.solution.num_iterations
            is_converged &= step.solution.termination_reason != "max-iter"
    return {"num_iterations": iterations, "num_products": products[0], "is_converged": is_converged}


def format_counts(row: dict[str, Any]) -> str:
    """Format the cell of a scene, a solver and a preconditioner."""
    iterations = f"{'' if row['is_converged'] else '>'}{row['num_iterations']}"
    return iterations if row["solver"] == "pncg" else f"{iterations}, {row['num_products']}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="*", type=Path, default=SCENES, metavar="SCENE")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    table, begin, rows = (
        Table("scene", "solver", *NAMES, box=SIMPLE_HEAD),
        describe_provenance(),
        list[dict[str, Any]](),
    )
    with limit_threads(1):
        for path in options.scenes:
            for name, solver in SOLVERS.items():
                found = [
                    {"scene": path.stem, "solver": name, "preconditioner": by}
                    | count_work(path, solver(preconditioner=by))
                    for by in NAMES
                ]
                table.add_row(path.stem, name, *map(format_counts, found))
                rows += found
    Console(width=120).print(table)
    publish_rows(options.publish, CONFIG, rows, begin, is_timed=False)


if __name__ == "__main__":
    main()
