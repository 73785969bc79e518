"""Measure offset geometric contact (`vbd-ogc`) compared with barriers: time, collisions and error.

    python -m tests.bench.offset_contact [--rounds 2] [--scenes SCENE ...] [--publish results/published/offset-contact]

Rough motions: each solver simulates the first frames of a scene. The solvers alternate step by step on one thread; the
time of a step is the least processor time of the rounds. Solvers with barriers stop at a relative residual of 1e-3 or
after 100 iterations, `vbd-ogc` after a fixed number.

    bad frames      frames with an edge that intersects a triangle or a pair within its minimum distance
    rejected paths  pairs of consecutive frames whose linear path is rejected by continuous collision detection of ipctk
    error           root mean square distance of the last positions from those of `hybrid` with residuals of 1e-6 [mm]

One step: the step after the last frame of `hybrid`, solved in 10 to 300 iterations from the same start.

    residual        of the barrier objective, relative to the start
    error           root mean square distance from the solution of `newton`, friction included [mm]
    change          root mean square distance from the iterate after the largest number of iterations [mm], which
                    decreases with the number of iterations if there is a fixed point
    radius          the error without friction, for activation distances that are a fraction of the minimum distance
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.harness.scenes.collision_primitives import find_collision_primitives
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.instrumentation_pass import count_intersections
from springbench.harness.simulation.time_loop import build_problem, prepare, simulate_scene
from springbench.solvers.contact.contact_potential import BarrierContact
from springbench.solvers.contact.lagged_friction import solve_with_friction
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.methods.vertex_block.vbd_offset_contact import OffsetContactDescent
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, StopRule

from tests.bench.scripted_study import describe_provenance, publish_rows

CONFIGS = Path(__file__).parents[2] / "configs"
SCENES: dict[str, tuple[str, int, int]] = {
    "net-on-block": ("touch", 5, 30),
    "gathered-curtain": ("contact-accuracy", 9, 20),
    "ten-sheets": ("touch", 3, 8),
}
"""Folder, size and frames of each scene: ropes on a block, a folded cloth, and layers under pressure."""


class StoppedSolver(NamedTuple):
    """A solver with its stop rule."""

    solver: Solver
    stop: StopRule


BARRIERS = StopRule(100, 1e-3)
MOTION_SOLVERS: dict[str, StoppedSolver] = {
    "vbd-ogc, 20": StoppedSolver(OffsetContactDescent(), StopRule(20)),
    "vbd-ogc, 100": StoppedSolver(OffsetContactDescent(), StopRule(100)),
    "vbd": StoppedSolver(VertexBlockDescent(), BARRIERS),
    "hybrid": StoppedSolver(HybridNewton(), BARRIERS),
    "newton": StoppedSolver(NewtonSolver(), BARRIERS),
}
REFERENCE = StoppedSolver(HybridNewton(), StopRule(300, 1e-6))
STEP_SOLVERS: dict[str, Solver] = {
    "vbd-ogc": OffsetContactDescent(),
    "vbd-ogc, redetection_fraction 0": OffsetContactDescent(redetection_fraction=0.0),
    "vbd": VertexBlockDescent(),
}
ITERATIONS = (10, 30, 100, 300)
RADIUS_RATIOS, RADIUS_ITERATIONS = (1.0, 0.5, 0.25), (100, 1000)


class Motion(NamedTuple):
    """A motion: positions of each frame, least processor time of each step [s], and mean number of iterations."""

    positions: list[Positions]
    step_seconds: list[float]
    mean_iterations: float


def simulate_interleaved(scene: Scene, frames: int, solvers: Sequence[StoppedSolver], rounds: int) -> list[Motion]:
    """Simulate a scene by several solvers interleaved step by step, and return their motions."""
    prepared = [prepare(scene, one.solver) for one in solvers]
    seconds, counts = np.full((len(solvers), frames), np.inf), np.zeros((len(solvers), frames))
    positions: list[list[Positions]] = []
    for number in range(rounds):
        positions = [[] for _ in solvers]
        steps = [
            iter(simulate_scene(scene, made, one.stop, initial_guess="extrapolated", frames=frames))
            for made, one in zip(prepared, solvers, strict=True)
        ]
        for k in range(frames):
            for j in range(len(solvers)) if (k + number) % 2 else reversed(range(len(solvers))):
                began = thread_time()
                step = next(steps[j])
                seconds[j, k] = min(seconds[j, k], thread_time() - began)
                counts[j, k] = step.num_iterations
                positions[j].append(step.positions.copy())
    return [Motion(p, s.tolist(), float(c.mean())) for p, s, c in zip(positions, seconds, counts, strict=True)]


def count_bad_frames(scene: Scene, positions: Sequence[Positions]) -> int:
    """Count the frames with an intersection, or a pair within its minimum distance; obstacles are at rest."""
    contacts = [energy for energy in scene.system.energies if isinstance(energy, BarrierContact)]
    return sum(
        bool(count_intersections(scene, p, 0.0)) or any(contact.find_violated_pairs(p) for contact in contacts)
        for p in positions
    )


def count_rejected_paths(scene: Scene, positions: Sequence[Positions]) -> int:
    """Count the pairs of consecutive frames whose linear path ipctk rejects for the mesh against itself."""
    import ipctk  # an optional extra

    edges, faces = find_collision_primitives(scene.mesh)
    mesh = ipctk.CollisionMesh(scene.mesh.rest_positions, edges, faces[faces[:, 1] != faces[:, 2]])
    return sum(not ipctk.is_step_collision_free(mesh, before, after) for before, after in pairwise(positions))


def measure_distance_mm(p: Positions, q: Positions) -> float:
    """Return the root mean square distance of positions (n, 3) [m] in mm."""
    return 1e3 * float(np.sqrt(((p - q) ** 2).sum(axis=1).mean()))


class Reference(NamedTuple):
    """The motion of a scene by `hybrid`, and the step that follows it."""

    scene: Scene
    end_positions: Positions
    problem: StepProblem
    minimum: Positions


def build_touching_scene(name: str, radius_ratio: float | None = None) -> Scene:
    """Build a scene; with a ratio, without friction and with contact radii relative to its minimum distances."""
    folder, size, _ = SCENES[name]
    spec = load_scene(CONFIGS / folder / f"{name}.yaml")
    effects: list[Any] = list(spec.effects)
    for k, one in enumerate(effects):
        if "contact" in one.kind and radius_ratio is not None:
            effects[k] = one.model_copy(update={"dhat": radius_ratio * one.min_distance, "friction": 0.0})
    return build_scene(spec.model_copy(update={"effects": tuple(effects)}), size, log_warnings=False)


def simulate_reference(name: str, radius_ratio: float | None = None) -> Reference:
    """Simulate a scene by `hybrid`, and solve the step after its frames by `newton`, with its friction."""
    scene = build_touching_scene(name, radius_ratio)
    prepared = prepare(scene, REFERENCE.solver)
    steps = simulate_scene(scene, prepared, REFERENCE.stop, initial_guess="extrapolated", frames=SCENES[name][2])
    last = list(steps)[-1]
    problem = build_problem(scene, last.state, "previous")
    solved = solve_with_friction(prepare(scene, NewtonSolver()), problem, StopRule(300, 1e-9))
    return Reference(scene, last.positions, solved.problem, solved.solution.positions)


def measure_motions(name: str, reference: Reference, rounds: int) -> list[dict[str, Any]]:
    """Measure the motion of a scene by each solver: a row for each."""
    scene, frames = reference.scene, SCENES[name][2]
    motions = simulate_interleaved(scene, frames, list(MOTION_SOLVERS.values()), rounds)
    return [
        {
            "kind": "motion",
            "scene": name,
            "solver": solver,
            "vertices": scene.system.num_vertices,
            "frames": frames,
            "iterations": motion.mean_iterations,
            "step_milliseconds": 1e3 * float(np.mean(motion.step_seconds)),
            "num_bad_frames": count_bad_frames(scene, motion.positions),
            "num_rejected_paths": count_rejected_paths(scene, motion.positions),
            "error_mm": measure_distance_mm(motion.positions[-1], reference.end_positions),
        }
        for solver, motion in zip(MOTION_SOLVERS, motions, strict=True)
    ]


def measure_step(name: str, reference: Reference) -> list[dict[str, Any]]:
    """Measure one step of a scene by numbers of iterations: a row for each solver and number."""
    problem = reference.problem
    local_global: Any = CompiledLocalGlobal().prepare(reference.scene.system)
    residual = local_global.build_residual(problem)
    start = residual(problem.current_positions)
    rows: list[dict[str, Any]] = []
    for solver, method in STEP_SOLVERS.items():
        prepared = prepare(reference.scene, method)
        iterates = [prepared.solve(problem, StopRule(count)).positions.copy() for count in ITERATIONS]
        rows += [
            {
                "kind": "step",
                "scene": name,
                "solver": solver,
                "iterations": float(count),
                "residual": residual(p) / start,
                "error_mm": measure_distance_mm(p, reference.minimum),
                "change_mm": measure_distance_mm(p, iterates[-1]),
            }
            for count, p in zip(ITERATIONS, iterates, strict=True)
        ]
    return rows


def measure_radii(name: str) -> list[dict[str, Any]]:
    """Measure the error of one step without friction by contact radius and iterations: a row for each."""
    rows: list[dict[str, Any]] = []
    for ratio in RADIUS_RATIOS:
        reference = simulate_reference(name, ratio)
        for count in RADIUS_ITERATIONS:
            prepared = prepare(reference.scene, OffsetContactDescent())
            p = prepared.solve(reference.problem, StopRule(count)).positions
            rows.append(
                {
                    "kind": "radius",
                    "scene": name,
                    "solver": "vbd-ogc",
                    "radius_ratio": ratio,
                    "iterations": float(count),
                    "error_mm": measure_distance_mm(p, reference.minimum),
                }
            )
    return rows


def build_motion_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Build the table of motions."""
    table = Table(
        "scene", "solver", "iterations", "ms a step", "bad frames", "rejected paths", "error, mm", box=SIMPLE_HEAD
    )
    table.title = f"rough motions with contact; {describe_machine().cpu}"
    for row in rows:
        table.add_row(
            row["scene"],
            row["solver"],
            f"{row['iterations']:.0f}",
            f"{row['step_milliseconds']:.2f}",
            str(row["num_bad_frames"]),
            str(row["num_rejected_paths"]),
            f"{row['error_mm']:.3g}",
        )
    return table


def build_step_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Build the table of single steps."""
    table = Table("scene", "solver", "iterations", "residual", "error, mm", "change, mm", box=SIMPLE_HEAD)
    for row in rows:
        numbers = (f"{row[key]:.2g}" for key in ("residual", "error_mm", "change_mm"))
        table.add_row(row["scene"], row["solver"], f"{row['iterations']:.0f}", *numbers)
    return table


def main() -> None:
    """Print both tables and the errors by radius for each scene."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, motions, steps, radii = describe_provenance(), *(list[dict[str, Any]]() for _ in range(3))
    with limit_threads(1):
        for name in options.scenes:
            reference = simulate_reference(name)
            motions += measure_motions(name, reference, options.rounds)
            Console(width=120).print(build_motion_table(motions[-len(MOTION_SOLVERS) :]))
            steps += measure_step(name, reference)
            Console(width=120).print(build_step_table(steps[-len(STEP_SOLVERS) * len(ITERATIONS) :]))
            radii += measure_radii(name)
            for row in radii[-len(RADIUS_RATIOS) * len(RADIUS_ITERATIONS) :]:
                title = f"{name}: radius {row['radius_ratio']:g}, {row['iterations']:.0f} iterations"
                Console(width=120).print(f"{title}: {row['error_mm']:.3g} mm")
            publish_rows(options.publish, CONFIGS / "contact-accuracy.yaml", motions + steps + radii, begin)


if __name__ == "__main__":
    main()
