"""Compare primal with dual descent by ratios of stiffness and of mass (Macklin, Erleben and Mueller 2020).

    python -m tests.bench.primal_dual [--publish results/published/primal-dual]

The problem is the first step of a chain of 17 vertices that hangs straight down. A ratio multiplies the stiffness of
every second spring in a chain of 1,000 N/m, or the mass of the last vertex in a chain of 100,000 N/m. Primal methods
update positions vertex by vertex: `vbd` by Gauss-Seidel sweeps, with and without acceleration, and `jgs2` without
neighbour rings by Jacobi sweeps. Dual methods update the tensions of springs: `xpbd` by Gauss-Seidel sweeps. A cell is
the number of iterations until the largest error of a coordinate is at most a thousandth of the step's largest
displacement; a dash denotes more than 100,000. The chain stays straight, so that XPBD converges to the minimum.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.position_based.xpbd import Xpbd
from springbench.solvers.methods.vertex_block.jgs2 import Jgs2
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.energies import spring_energy
from springbench.solvers.model.step_problem import Solver, StepProblem, StopRule

from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.scene_builders import build_first_problem, build_test_scene

CHAIN = Path(__file__).parents[2] / "configs" / "scenes" / "chain.yaml"
RATIOS = (1.0, 10.0, 100.0, 1e3, 1e4)
METHODS: dict[str, Solver] = {
    "primal, Jacobi: jgs2, neighbour_rings: 0": Jgs2(neighbour_rings=0),
    "primal, Gauss-Seidel: vbd, spectral_radius: 0": VertexBlockDescent(spectral_radius=0.0),
    "primal, accelerated: vbd": VertexBlockDescent(),
    "dual, Gauss-Seidel: xpbd": Xpbd(),
}
LEVEL, MAX_ITERATIONS = 1e-3, 100_000
"""Largest error over the step's displacement, and iteration limit."""


def build_hanging_chain(stiffness: float, stiffness_ratio: float = 1.0, mass_ratio: float = 1.0) -> StepProblem:
    """Build the first step of the hanging chain.

    stiffness: of the springs [N/m]; stiffness_ratio: factor of every second spring; mass_ratio: factor of the last
    mass.
    """
    pins = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
    down = ChainMesh(direction=(0.0, -1.0, 0.0))
    problem = build_first_problem(
        build_test_scene(
            down, SpringsEffect(scaling_rule="fixed", stretch=stiffness), GravityEffect(), pins, size=17, mass=1.0
        )
    )
    mass = problem.system.mass.copy()
    mass[-1] *= mass_ratio
    (found,) = problem.system.energies
    assert isinstance(found, spring_energy.Springs)
    k = np.where(np.arange(len(found.edges)) % 2, stiffness_ratio, 1.0) * found.stiffness
    energies = (replace(found, stiffness=k),)
    force = problem.external_force * (mass / problem.system.mass)[:, None]
    return replace(problem, system=replace(problem.system, mass=mass, energies=energies), external_force=force)


def count_iterations(solver: Solver, problem: StepProblem) -> int | None:
    """Count the iterations until the error is at most LEVEL; return None if the iteration limit is not sufficient."""
    end = NewtonSolver().prepare(problem.system).solve(problem, StopRule(200, 1e-12)).positions
    displacement = float(np.abs(end - problem.current_positions).max())
    for k, p in enumerate(islice(solver.prepare(problem.system).iterates(problem), MAX_ITERATIONS), 1):
        if np.abs(p - end).max() <= LEVEL * displacement:
            return k
    return None


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    problems_by_title = {
        "stiffer springs": [build_hanging_chain(1e3, stiffness_ratio=ratio) for ratio in RATIOS],
        "a heavier end": [build_hanging_chain(1e5, mass_ratio=ratio) for ratio in RATIOS],
    }
    with limit_threads(1):
        for title, problems in problems_by_title.items():
            table = Table(f"{title}, by", *(f"{ratio:,.0f}" for ratio in RATIOS), box=SIMPLE_HEAD)
            for name, solver in METHODS.items():
                counts = [count_iterations(solver, problem) for problem in problems]
                table.add_row(name, *("–" if count is None else f"{count:,}" for count in counts))
                rows += [
                    {"ratio_of": title, "ratio": ratio, "method": name, "num_iterations": count}
                    for ratio, count in zip(RATIOS, counts, strict=True)
                ]
            Console(width=120).print(table)
    publish_rows(options.publish, CHAIN, rows, begin, is_timed=False)


if __name__ == "__main__":
    main()
