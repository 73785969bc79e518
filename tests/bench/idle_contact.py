"""What contact costs while nothing is near: steps of cloth with contact over steps without.

    python -m tests.bench.idle_contact [--sizes 33 64 128] [--solvers hybrid newton] [--scenes cloth flag]

The swinging cloth and the flag are simulated to a relative residual of 1e-6: with self-contact, with surface contact to
a plane 5 m below, and without. Both simulations advance one step each in turn on one thread, in several rounds. A cell
is the ratio of the processor times of all steps after the first two, up to the first in which contact acts; of each step
the least time of the rounds counts. The number of these steps follows.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import thread_time

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.model.step_problem import Positions, StopRule
from springbench.solvers.registry import SOLVERS, load_target

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
CLOTHS = {"cloth": "hanging-cloth.yaml", "flag": "flag-in-wind.yaml"}
CONTACTS: dict[str, SceneEffect] = {
    "self-contact": SelfContactEffect(min_distance=0.002, friction=0.3),
    "surface-contact": SurfaceContactEffect.model_validate(
        {"obstacles": [{"kind": "plane", "point": (0, -5, 0)}], "min_distance": 0.005, "friction": 0.3}
    ),
}
STOP, NUM_WARMUP_STEPS = StopRule(5000, 1e-6), 2


def measure_step_ratio(
    cloth: str, effect: SceneEffect, size: int, solver: str, frames: int, rounds: int
) -> tuple[float, int, float]:
    """Return the ratio of processor times with an effect to those without, the number of steps, and a step's time [s].

    Args:
        cloth: name of the scene.
        effect: kind of contact.
        size: mesh size.
        solver: name of the solver.
        frames: largest number of steps.
        rounds: number of repetitions.
    """
    spec = load_scene(SCENES / CLOTHS[cloth])
    both = [spec.model_copy(update={"effects": (*spec.effects, *more)}) for more in ((effect,), ())]
    scenes = [build_scene(one, size, log_warnings=False) for one in both]
    prepared = [prepare(scene, load_target(SOLVERS[solver])()) for scene in scenes]
    least = np.full((frames, 2), np.inf)
    for number in range(rounds):
        steps = [
            iter(simulate_scene(*it, STOP, initial_guess="previous", frames=frames))
            for it in zip(scenes, prepared, strict=True)
        ]
        for k in range(len(least)):
            found: dict[int, Positions] = {}
            for j in (0, 1) if (k + number) % 2 else (1, 0):
                began = thread_time()
                found[j] = next(steps[j]).positions
                least[k, j] = min(least[k, j], thread_time() - began)
            if not np.array_equal(found[0], found[1]):
                least = least[:k]
                break
    least = least[NUM_WARMUP_STEPS:]
    with_contact, without = least.sum(axis=0).tolist()
    return with_contact / without, len(least), without / len(least)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[33, 64, 128])
    parser.add_argument("--solvers", nargs="+", default=["hybrid", "newton"])
    parser.add_argument("--scenes", nargs="+", choices=CLOTHS, default=list(CLOTHS))
    parser.add_argument("--contacts", nargs="+", choices=CONTACTS, default=list(CONTACTS))
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    table = Table("scene", "a side", "solver", "step without [ms]", *options.contacts, box=SIMPLE_HEAD)
    table.title = f"a step with contact that is idle over one without; {describe_machine().cpu}"
    with limit_threads(1):
        for cloth in options.scenes:
            for size in options.sizes:
                for solver in options.solvers:
                    cells, without = list[str](), np.nan
                    for name in options.contacts:
                        given = CONTACTS[name], size, solver, options.frames, options.rounds
                        ratio, count, without = measure_step_ratio(cloth, *given)
                        cells.append(f"{ratio:.3f} ({count})")
                    table.add_row(cloth, str(size), solver, f"{1e3 * without:.3g}", *cells)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
