"""Primal compared with dual descent, by ratios of stiffness and of mass (Macklin, Erleben and Mueller 2020).

    python -m tests.bench.primal_dual [--publish results/published/primal-dual]

A chain of 17 vertices that hangs straight, its first step: a ratio multiplies the stiffness of every second spring of
1,000 N/m, or the last mass of a chain of 100,000 N/m. Primal methods change positions vertex by vertex: `vbd`, by Gauss
and Seidel, with and without its acceleration, and Jacobi's (`jgs2`, `neighbour_rings: 0`). Dual ones change the
tensions of springs: `xpbd`, by Gauss and Seidel. A cell is how many iterations it takes until every vertex is within a
thousandth of the step's displacement of where it ends; a dash: not within 100,000. The line stays straight, so what
XPBD tends to is the minimum.
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
LEVEL, MOST = 1e-3, 100_000
"""Distance from the end over the step's displacement, and iterations at most."""


def hanging(stiffness: float, stiffer: float = 1.0, heavier: float = 1.0) -> StepProblem:
    """The chain's first step. stiffness: of springs [N/m]; stiffer: every second one; heavier: the last vertex."""
    pins = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
    down = ChainMesh(direction=(0.0, -1.0, 0.0))
    stated = build_first_problem(
        build_test_scene(
            down, SpringsEffect(scaling_rule="fixed", stretch=stiffness), GravityEffect(), pins, size=17, mass=1.0
        )
    )
    mass = stated.system.mass.copy()
    mass[-1] *= heavier
    (found,) = stated.system.energies
    assert isinstance(found, spring_energy.Springs)
    k = np.where(np.arange(len(found.edges)) % 2, stiffer, 1.0) * found.stiffness
    energies = (replace(found, stiffness=k),)
    force = stated.external_force * (mass / stated.system.mass)[:, None]
    return replace(stated, system=replace(stated.system, mass=mass, energies=energies), external_force=force)


def iterations(solver: Solver, stated: StepProblem) -> int | None:
    """Iterations until all vertices are within the requested distance of the minimum."""
    end = NewtonSolver().prepare(stated.system).solve(stated, StopRule(200, 1e-12)).positions
    displacement = float(np.abs(end - stated.current_positions).max())
    for k, p in enumerate(islice(solver.prepare(stated.system).iterates(stated), MOST), 1):
        if np.abs(p - end).max() <= LEVEL * displacement:
            return k
    return None


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    problems = {
        "stiffer springs": [hanging(1e3, stiffer=ratio) for ratio in RATIOS],
        "a heavier end": [hanging(1e5, heavier=ratio) for ratio in RATIOS],
    }
    with limit_threads(1):
        for title, stated in problems.items():
            table = Table(f"{title}, by", *(f"{ratio:,.0f}" for ratio in RATIOS), box=SIMPLE_HEAD)
            for name, solver in METHODS.items():
                counts = [iterations(solver, one) for one in stated]
                table.add_row(name, *("–" if count is None else f"{count:,}" for count in counts))
                rows += [
                    {"ratio_of": title, "ratio": ratio, "method": name, "num_iterations": count}
                    for ratio, count in zip(RATIOS, counts, strict=True)
                ]
            Console(width=120).print(table)
    publish_rows(options.publish, CHAIN, "python -m tests.bench.primal_dual", rows, begin, is_timed=False)


if __name__ == "__main__":
    main()
