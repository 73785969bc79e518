"""Compare half spaces with barriers as contact with the same floor, by time and penetration.

    python -m tests.bench.half_spaces [--size 24] [--block 4] [--frames 40] [--rounds 2] [--solvers hybrid newton]
        [--publish results/published/half-spaces]

Each scene has the effect `contact` (vertices against half spaces), or `surface-contact` (barriers) with the same plane
and minimum distance. It is simulated to a relative residual of 1e-6. Thin barriers have an activation distance of a
tenth of the minimum distance, the depth to which half spaces may be entered. The simulations alternate step by step on
one thread, in several rounds. The time of a step is the least processor time of the rounds.

    nothing near    time of a step of the hanging cloth 5 m above the floor, relative to the cloth without a floor
    resting         time of a step of a block that has fallen 5 cm, over the last third of the frames [ms]
    resting height  height of its lowest layer of vertices above the minimum distance at the end [mm]
    limited steps   in two hard cases: steps that reach the iteration limit, and the largest depth of a vertex below the
                    minimum distance [mm]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.model.step_problem import Positions, StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

CONFIGS = Path(__file__).parents[2] / "configs"
FLOORS: dict[str, tuple[Any, float | None]] = {
    "half spaces": (ContactEffect, None),
    "barriers": (SurfaceContactEffect, 1.0),
    "thin barriers": (SurfaceContactEffect, 0.1),
}
"""Effect, and the activation distance of barriers relative to the minimum distance."""
MIN_DISTANCE, NUM_WARMUP_STEPS = 0.005, 2
STOP = StopRule(500, 1e-6)
HARD_CASES = ("thrown-1e4", "at-the-thickness")
"""The hard cases whose obstacle is a plane and whose mesh is small."""


class Motion(NamedTuple):
    """Motion with one kind of floor.

    step_seconds: least processor time of each step [s]; positions: last ones (n, 3) [m]; num_limited_steps: steps that
    reach the iteration limit; lowest_height: of all vertices and steps [m].
    """

    step_seconds: NDArray[np.float64]
    positions: Positions
    num_limited_steps: int
    lowest_height: float


def build_floor(kind: str, height: float, min_distance: float = MIN_DISTANCE) -> SceneEffect:
    """Build the floor of a kind in FLOORS at a height [m]."""
    effect, dhat_ratio = FLOORS[kind]
    given: dict[str, Any] = {"obstacles": [{"kind": "plane", "point": (0.0, height, 0.0)}], "friction": 0.3}
    if dhat_ratio is not None:
        given["dhat"] = dhat_ratio * min_distance
    return effect.model_validate({**given, "min_distance": min_distance})


def simulate_interleaved(
    specs: Sequence[SceneSpec], size: int | None, solver: str, frames: int, rounds: int
) -> list[Motion]:
    """Simulate scenes interleaved step by step, and return their motions."""
    scenes = [build_scene(one, size or one.default_size or 0, log_warnings=False) for one in specs]
    prepared = [prepare(scene, load_target(SOLVERS[solver])()) for scene in scenes]
    seconds, limited = np.full((len(specs), frames), np.inf), np.zeros(len(specs), int)
    lowest, ends = np.full(len(specs), np.inf), [scene.mesh.rest_positions for scene in scenes]
    for number in range(rounds):
        limited[:] = 0
        steps = [
            iter(simulate_scene(*it, STOP, initial_guess="previous", frames=frames))
            for it in zip(scenes, prepared, strict=True)
        ]
        for k in range(frames):
            for j in range(len(specs)) if (k + number) % 2 else reversed(range(len(specs))):
                began = thread_time()
                step = next(steps[j])
                seconds[j, k] = min(seconds[j, k], thread_time() - began)
                limited[j] += step.solution.termination_reason == "max-iter"
                ends[j] = step.positions.copy()
                lowest[j] = min(lowest[j], float(ends[j][:, 1].min()))
    return [Motion(*it) for it in zip(seconds, ends, limited.tolist(), lowest.tolist(), strict=True)]


def measure_idle(size: int, solver: str, frames: int, rounds: int) -> list[dict[str, Any]]:
    """Measure the ratio of a step with each floor far below to one without a floor."""
    spec = load_scene(CONFIGS / "scenes" / "hanging-cloth.yaml")
    floors: list[tuple[SceneEffect, ...]] = [(), *((build_floor(kind, -5.0),) for kind in FLOORS)]
    motions = simulate_interleaved(
        [spec.model_copy(update={"effects": (*spec.effects, *floor)}) for floor in floors], size, solver, frames, rounds
    )
    without, *others = (float(motion.step_seconds[NUM_WARMUP_STEPS:].sum()) for motion in motions)
    return [{"idle_ratio": one / without} for one in others]


def measure_resting(size: int, solver: str, frames: int, rounds: int) -> list[dict[str, Any]]:
    """Measure the time of a step at rest [ms], and the error of the resting height [mm], for each floor."""
    spec = load_scene(CONFIGS / "scenes" / "block-drop.yaml")
    start = float(build_scene(spec, size, log_warnings=False).mesh.rest_positions[:, 1].min())
    floor = start - 0.05 - MIN_DISTANCE
    motions = simulate_interleaved(_replace_contact(spec, floor), size, solver, frames, rounds)
    return [
        {
            "step_milliseconds": 1e3 * float(np.median(motion.step_seconds[-frames // 3 :])),
            "height_error_mm": 1e3 * (_compute_lowest_height(motion.positions, size) - floor - MIN_DISTANCE),
        }
        for motion in motions
    ]


def measure_hard_case(name: str, solver: str) -> list[dict[str, Any]]:
    """Count for each floor the steps at the iteration limit of a hard case, and measure its deepest vertex [mm]."""
    spec = load_scene(CONFIGS / "hard-touch" / f"{name}.yaml")
    last: Any = spec.effects[-1]
    floor = float(last.obstacles[0].point[1])
    motions = simulate_interleaved(_replace_contact(spec, floor, last.min_distance), None, solver, spec.frames, 1)
    return [
        {
            "num_limited_steps": motion.num_limited_steps,
            "depth_mm": max(0.0, 1e3 * (floor + last.min_distance - motion.lowest_height)),
        }
        for motion in motions
    ]


def _replace_contact(spec: SceneSpec, floor: float, min_distance: float = MIN_DISTANCE) -> list[SceneSpec]:
    """Return the scene with each floor, and no other contact."""
    others = tuple(effect for effect in spec.effects if "contact" not in effect.kind)
    return [spec.model_copy(update={"effects": (*others, build_floor(kind, floor, min_distance))}) for kind in FLOORS]


def _compute_lowest_height(p: Positions, size: int) -> float:
    """Return the mean height [m] of the lowest layer of a block with `size` vertices a side."""
    return float(np.sort(p[:, 1])[: size * size].mean())


def measure_solver(solver: str, size: int, block_size: int, frames: int, rounds: int) -> list[dict[str, Any]]:
    """Measure all scenes with one solver: a row for each scene and floor."""
    measured = {
        "hanging-cloth": measure_idle(size, solver, 16, rounds),
        "block-drop": measure_resting(block_size, solver, frames, rounds),
        **{name: measure_hard_case(name, solver) for name in HARD_CASES},
    }
    return [
        {"solver": solver, "scene": scene, "floor": kind, **row}
        for scene, found in measured.items()
        for kind, row in zip(FLOORS, found, strict=True)
    ]


def build_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Build the table of all rows, with a column for each floor."""
    table = Table("solver", "measured", *FLOORS, box=SIMPLE_HEAD)
    table.title = f"the same floor as half spaces and as barriers; {describe_machine().cpu}"
    lines = {
        ("hanging-cloth", "nothing near, ratio"): "{idle_ratio:.3f}",
        ("block-drop", "resting, ms a step"): "{step_milliseconds:.2f}",
        ("block-drop", "resting height, mm"): "{height_error_mm:+.3f}",
        **{(name, f"{name}: limited steps; depth, mm"): "{num_limited_steps}; {depth_mm:.3g}" for name in HARD_CASES},
    }
    for solver in dict.fromkeys(row["solver"] for row in rows):
        for (scene, quantity), form in lines.items():
            found = [row for row in rows if (row["solver"], row["scene"]) == (solver, scene)]
            table.add_row(solver, quantity, *(form.format_map(row) for row in found))
    return table


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=24, help="vertices a side of the cloth")
    parser.add_argument("--block", type=int, default=4, help="vertices a side of the block")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--solvers", nargs="+", default=["hybrid", "newton"])
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    with limit_threads(1):
        for solver in options.solvers:
            rows += measure_solver(solver, options.size, options.block, options.frames, options.rounds)
    Console(width=120).print(build_table(rows))
    config = CONFIGS / "scenes" / "block-drop.yaml"
    publish_rows(options.publish, config, rows, begin)


if __name__ == "__main__":
    main()
