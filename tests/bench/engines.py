"""Compare third-party engines with this project's solvers by residuals, drift of energy, and stability.

    python -m tests.bench.engines [SCENE ...] [--size 9] [--frames 30] [--substeps 4 16 64 256]

The scenes have no drag, so that the method causes all changes of the total energy. A cell of the table is
`residual / drift`, for a number of substeps. The residual is |Q^-1 grad g|_Q of the step problem of implicit Euler at
the method's positions, over its value at the step's start, the median over the frames. It is 0 for a method that
minimises the objective. The drift is the change of kinetic, elastic and gravitational energy over the largest kinetic
energy. A dash denotes positions that are not finite, or displaced by more than ten times the mesh's diagonal.
`refused` denotes an engine that does not support the scene or is not installed; the row of `springbench run` states the
reason.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state, prepare, simulate_scene
from springbench.solvers.methods.time_stepping.explicit_forces import estimate_max_frequency
from springbench.solvers.model.step_problem import Positions, StopRule, Unsupported
from springbench.solvers.registry import SOLVER_TABLE, load_target

SCENES = [Path(__file__).parents[2] / "configs" / "scenes" / f"{name}.yaml" for name in ("curtain", "stiff-cloth-sway")]
ENGINES: tuple[tuple[str, dict[str, Any]], ...] = (
    *(("mujoco", {"mujoco_integrator": one}) for one in ("implicitfast", "implicit", "Euler", "RK4")),
    *(("pypbd", {"iterations_per_substep": one}) for one in (1, 4, 16)),
    ("newton-physics", {"newton_solver": "vbd", "iterations_per_substep": 10}),
    ("newton-physics", {"newton_solver": "vbd", "iterations_per_substep": 10, "colouring_source": "newton"}),
    ("newton-physics", {"newton_solver": "xpbd", "iterations_per_substep": 1}),
    ("newton-physics", {"newton_solver": "semi-implicit"}),
    *(("taichi", {"iterations_per_substep": one}) for one in (1, 4)),
    ("xpbd-small-steps", {}),
)
OWN_SOLVERS = (("velocity-verlet", "substepping", StopRule(1)), ("hybrid", "implicit-euler", StopRule(200, 1e-6)))
MAX_DISPLACEMENT = 10.0
"""Displacement above which a simulation is unstable, in diagonals of the mesh."""


def compute_energy(scene: Scene, p: Positions, v: Positions) -> tuple[float, float]:
    """Compute the total and the kinetic energy [J]."""
    kinetic = 0.5 * float(scene.system.mass @ np.einsum("ij,ij->i", v, v))
    return kinetic + scene.all_springs.value(p) - float(np.einsum("ij,ij->", scene.constant_force, p)), kinetic


def measure_cell(scene: Scene, solver: Any, stop: StopRule, frames: int) -> str:
    """Simulate a scene by a solver, and format the cell of its residual and drift."""
    evaluator, size, initial = (
        ReferenceEvaluator(scene.system),
        scene.mesh.bounding_box_diagonal or 1.0,
        build_initial_state(scene).motion,
    )
    first, max_kinetic = compute_energy(scene, *initial)
    last, residuals = first, list[float]()
    try:
        for step in simulate_scene(scene, prepare(scene, solver), stop, initial_guess="previous", frames=frames):
            p, v = step.state.motion
            if not np.isfinite(p).all() or np.abs(p - scene.mesh.rest_positions).max() > MAX_DISPLACEMENT * size:
                return "–"
            residuals.append(evaluator.measure_stationarity(step.problem, p).stationarity)
            last, kinetic = compute_energy(scene, p, v)
            max_kinetic = max(max_kinetic, kinetic)
    except Unsupported:
        return "refused"
    return f"{np.median(residuals):.1e} / {100 * (last - first) / max_kinetic:+.2g} %"


def measure_scene(path: Path, size: int, frames: int, substeps: list[int]) -> Iterator[tuple[str, ...]]:
    """Yield a table row for each engine and solver on a scene."""
    scene = build_exact_scene(load_scene(path), size, "substepping")
    for name, parameters in ENGINES:
        made = load_target(SOLVER_TABLE[name])(**parameters)
        title = " ".join(map(str, (name, *parameters.values())))
        yield title, *(measure_cell(scene, made, StopRule(number), frames) for number in substeps)
    for name, integrator, stop in OWN_SOLVERS:
        yield (
            f"{name}, {integrator}",
            measure_cell(
                build_exact_scene(load_scene(path), size, integrator), load_target(SOLVER_TABLE[name])(), stop, frames
            ),
        )


def main() -> None:
    """Print a table for each scene."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="*", type=Path, default=SCENES, metavar="SCENE")
    parser.add_argument("--size", type=int, default=9)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--substeps", type=int, nargs="+", default=[4, 16, 64, 256])
    options = parser.parse_args()
    with limit_threads(1):
        for path in options.scenes:
            system = build_exact_scene(load_scene(path), options.size, "substepping").system
            least = estimate_max_frequency(system) * system.time_step / 2.0
            title = f"{path.stem} {options.size}: omega h is 2 at {least:.3g} substeps"
            table = Table("substeps", *map(str, options.substeps), box=SIMPLE_HEAD, title=title)
            for row in measure_scene(path, options.size, options.frames, options.substeps):
                table.add_row(*row)
            Console(width=140).print(table)


if __name__ == "__main__":
    main()
