"""What an iteration costs with an effect, over one without: each effect by each solver, side by side.

    python -m tests.bench.effects [--size 33] [--rounds 3] [--frames 8] [SOLVER ...]

The hanging cloth is simulated to a tolerance of 1e-6, the one with the effect and the one without step by step in
turns, by CPU time of the one thread. An iteration is what the solver counts as one. Each cell tells the ratio, how it
is reached (ms an iteration) and the limit that it is to keep.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import thread_time

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from harness.base.machine import pinned_threads
from harness.config.load import load_scene
from harness.scenes.bind import build
from harness.scenes.spec import SceneSpec
from harness.simulation.step import Step, prepare, simulate
from solvers.problem import StopRule, Unsupported
from solvers.registry import SOLVERS, load

PRICES = Path(__file__).parents[2] / "configs" / "prices.yaml"
BARE = {"springs", "gravity", "ether-drag", "pins"}
STOP = StopRule(5000, 1e-6)
WARM = 2
"""Steps before those that count."""

SOLVED = ("newton", "hybrid", "newton-cg", "lbfgs", "vbd")
CHEAP, LINES, BENDING, IDLE, ALL = range(5)
KINDS = {
    "air-drag": CHEAP, "attachments": CHEAP, "wind": CHEAP, "contact": IDLE, "strain-limits": LINES,
    "dashpots": LINES, "rayleigh": LINES, "bending": BENDING, "all": ALL,
}  # fmt: skip
LIMITS = {
    "newton": (1.05, 1.5, 3.0, 1.02, 4.0),
    "hybrid": (1.05, 1.4, 2.0, 1.02, 3.0),
    "newton-cg": (1.05, 1.4, 2.0, 1.02, 3.0),
    "lbfgs": (1.05, 1.6, 1.6, 1.02, 3.0),
    "vbd": (1.1, 1.5, 2.0, 1.1, 4.0),
}
"""By solver and by kind of effect."""


@dataclass(eq=False)
class Run:
    """A scene on its way by one solver: seconds of its steps, and its iterations."""

    steps: Iterator[Step]
    seconds: float = 0.0
    iterations: int = 0

    @classmethod
    def of(cls, scene: SceneSpec, size: int, solver: str, frames: int) -> Run:
        """Raises Unsupported."""
        made = build(scene, size)
        ready = prepare(made, load(SOLVERS[solver])())
        return cls(iter(simulate(made, ready, STOP, first_guess="current", frames=WARM + frames)))

    def step(self, *, counts: bool) -> None:
        """One step more."""
        began = thread_time()
        done = next(self.steps)
        if counts:
            self.seconds += thread_time() - began
            self.iterations += done.solution.iterations

    @property
    def each(self) -> float:
        """Seconds an iteration."""
        return self.seconds / max(1, self.iterations)


def only(scene: SceneSpec, *kinds: str) -> SceneSpec:
    """The scene with these effects alone, and those that every one has."""
    return scene.model_copy(update={"effects": tuple(e for e in scene.effects if e.kind in BARE.union(kinds))})


def measured(scene: SceneSpec, size: int, solver: str, rounds: int, frames: int) -> tuple[float, float]:
    """The ratio, the median of the rounds, and the seconds of an iteration with the effects."""
    ratios, each = [], []
    for _ in range(rounds):
        runs = [Run.of(one, size, solver, frames) for one in (scene, only(scene))]
        for k in range(WARM + frames):
            for run in runs:
                run.step(counts=k >= WARM)
        ratios.append(runs[0].each / runs[1].each)
        each.append(runs[0].each)
    return float(np.median(ratios)), float(min(each))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("solvers", nargs="*", default=SOLVED, metavar="SOLVER")
    for name, given in (("--size", 33), ("--rounds", 3), ("--frames", 8)):
        parser.add_argument(name, type=int, default=given)
    parser.add_argument("--effects", nargs="*", default=list(KINDS))
    asked = parser.parse_args()
    whole = load_scene(PRICES)
    table = Table(box=SIMPLE_HEAD, title=f"an iteration with the effect over one without, {asked.size} vertices a side")
    for heading in ("effect", *asked.solvers):
        table.add_column(heading, justify="right")
    with pinned_threads(1):
        for effect in asked.effects:
            scene = whole if effect == "all" else only(whole, effect)
            cells = []
            for solver in asked.solvers:
                try:
                    ratio, each = measured(scene, asked.size, solver, asked.rounds, asked.frames)
                except Unsupported:
                    cells.append("refused")
                    continue
                limit = LIMITS[solver][KINDS[effect]]
                cells.append(f"{ratio:.2f} ({1e3 * each:.3g} ms; limit {limit:g}{'' if ratio <= limit else ' !'})")
            table.add_row(effect, *cells)
    Console(width=200).print(table)


if __name__ == "__main__":
    main()
