"""XPBD and MGPBD beside each other, where papers measure them: in the dual.

    python -m tests.bench.duals [--setup]

What the tensions of springs are off by, |K^1/2 C - K^-1/2 t|, over what it is where a step begins (MGPBD draws
|C - t/k|, which is the same where all springs are alike): how many iterations it takes to a hundredth, a thousandth, a
millionth, and where XPBD is after 500. Then how far the end is from the step's minimum, over how far the step goes, at
the worst vertex; and the processor time to a hundredth, MGPBD's over XPBD's. --setup: iterations of conjugate gradients
to 1e-6 in the step's first linear system, by what makes the prolongations, and the megabytes that each goes through.

A chain, cloths in their third step, and a cube of springs that was pressed flat and lets go, as the paper's bunny does.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from harness.base.machine import pinned_threads
from harness.config.load import load_scene
from harness.scenes.bind import build
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins as PinsEffect
from harness.scenes.effects.springs import Springs as SpringsEffect
from harness.scenes.mesh.chain import Chain
from harness.scenes.mesh.solids import Block
from harness.simulation.step import State, prepare, problem, simulate
from solvers.core.prefactored import only_springs
from solvers.integrators import Motion
from solvers.linear.near_kernel import Cycle, Solving
from solvers.methods.hybrid import Hybrid
from solvers.methods.mgpbd import MultigridXpbd
from solvers.methods.newton import Newton
from solvers.methods.xpbd import PreparedXpbd, Xpbd
from solvers.problem import StepProblem, StopRule
from tests.scenes import first_problem, scene

CONFIGS = Path(__file__).parents[2] / "configs"
CLOTHS = {
    "cloth, 100 N/m, 24": ("hessians/cloth-100-pressed-0.yaml", 24),
    "cloth, 10,000 N/m, 24": ("hessians/cloth-1e4-pressed-0.yaml", 24),
    "cloth, 10,000 N/m, 64": ("hessians/cloth-1e4-pressed-0.yaml", 64),
    "cloth, 100,000 N/m, 32": ("scenes/yardstick-cloth.yaml", 32),
    "cloth, 100,000 N/m, 64": ("scenes/yardstick-cloth.yaml", 64),
}
CUBES = {"cube, 1 MPa, 11": (11, 1e6), "cube, 100 MPa, 11": (11, 1e8), "cube, 100 MPa, 16": (16, 1e8)}
LEVELS = (1e-2, 1e-3, 1e-6)
MOST, STALL = {"xpbd": 20_000, "mgpbd": 60}, 500
ALONE = "smoothing alone"
MADE = {
    ALONE: MultigridXpbd(components=0),
    "equal tensions": MultigridXpbd(components=0),
    "near-kernel": MultigridXpbd(),
    "equal, smoothed": MultigridXpbd(components=0, smoothed=True),
    "near-kernel, smoothed": MultigridXpbd(smoothed=True),
}


class Course(NamedTuple):
    """misfits: after each iteration, over that before the first; seconds: of processor time until each; end: positions
    (n, 3) [m]; linear: iterations of conjugate gradients in each."""

    misfits: list[float]
    seconds: list[float]
    end: np.ndarray
    linear: list[int]

    def until(self, level: float) -> int | None:
        """How many iterations it takes to a level; None where it does not come there."""
        return next((k for k, misfit in enumerate(self.misfits, 1) if misfit <= level), None)


def cloth(path: str, size: int) -> StepProblem:
    """The third step of a cloth from rest."""
    made = build(load_scene(CONFIGS / path), size)
    *_, last = simulate(made, prepare(made, Hybrid()), StopRule(500, 1e-6), first_guess="current", frames=3)
    return last.problem


def cube(size: int, modulus: float) -> StepProblem:
    """The first step of a cube of a metre and a ton that was pressed flat."""
    made = scene(Block(height=1.0, depth=1.0), SpringsEffect(stretch=modulus), size=size, mass=1000.0, time_step=0.01)
    flat = made.mesh.rest * [1.0, 0.0, 1.0]
    return problem(made, State(Motion(flat, np.zeros_like(flat)), None, 0), "current")


def chain() -> StepProblem:
    """The first step of a chain that is held at both ends."""
    pins = PinsEffect.model_validate({"at": ["ends"], "weight": "exact"})
    return first_problem(scene(Chain(length=2.0), SpringsEffect(stretch=1e4), Gravity(), pins, size=3000))


PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "chain, 10,000 N, 3000": chain,
    **{name: lambda path=path, size=size: cloth(path, size) for name, (path, size) in CLOTHS.items()},
    **{name: lambda size=size, modulus=modulus: cube(size, modulus) for name, (size, modulus) in CUBES.items()},
}


class Reached(NamedTuple):
    """misfit [J^(1/2)], positions (n, 3) [m], iterations of conjugate gradients in the last iteration, and what
    processor time all of them took [s]."""

    misfit: float
    positions: np.ndarray
    linear: int = 0
    seconds: float = 0.0


def xpbd(stated: StepProblem) -> Iterator[Reached]:
    """XPBD, before its first iteration and after each."""
    made = Xpbd().prepare(stated.system)
    assert isinstance(made, PreparedXpbd)
    run, own = made.begin(stated, stated.first_guess), made.constraints
    root, (i, j), seconds = np.sqrt(own.stiffness), own.ends.T, 0.0
    while True:
        p = run.positions
        stretched = root * (np.linalg.norm(p[i] - p[j], axis=1) - own.rest_length)
        yield Reached(float(np.linalg.norm(stretched - run.tension / root)), p, 0, seconds)
        began = time.process_time()
        run.advance()
        seconds += time.process_time() - began


def mgpbd(stated: StepProblem, solver: MultigridXpbd) -> Iterator[Reached]:
    """MGPBD, likewise; it ends where nothing moves any more."""
    run, moved, seconds = solver.prepare(stated.system).begin(stated, stated.first_guess), True, 0.0
    while moved:
        yield Reached(float(np.linalg.norm(run.misfit)), run.positions, run.iterations, seconds)
        began = time.process_time()
        moved = run.advance()
        seconds += time.process_time() - began


def course(run: Iterator[Reached], most: int) -> Course:
    """Until the last level is reached, or for so many iterations."""
    begin = next(run)
    found = Course([], [], begin.positions.copy(), [])
    for now in run:
        found.misfits.append(now.misfit / begin.misfit)
        found.seconds.append(now.seconds)
        found.linear.append(now.linear)
        found.end[:] = now.positions
        if now.misfit <= LEVELS[-1] * begin.misfit or len(found.misfits) == most:
            break
    return found


def courses(name: str) -> list[str]:
    """The row of a problem."""
    stated = PROBLEMS[name]()
    minimum = Newton().prepare(stated.system).solve(stated, StopRule(2000, 1e-9)).positions
    way = float(np.abs(minimum - stated.current).max())
    plain, global_ = course(xpbd(stated), MOST["xpbd"]), course(mgpbd(stated, MultigridXpbd()), MOST["mgpbd"])
    row = [name, f"{len(only_springs(stated.system, name).edges):,}"]
    for found in (plain, global_):
        row.append(", ".join("-" if (k := found.until(level)) is None else f"{k:,}" for level in LEVELS))
        row.append(f"{np.abs(found.end - minimum).max() / way:.1e}")
    row.insert(3, f"{plain.misfits[STALL - 1]:.2g}" if len(plain.misfits) >= STALL else "-")
    row.append(f"{np.mean(global_.linear):.0f}")
    a, b = plain.until(LEVELS[0]), global_.until(LEVELS[0])
    if b is None:
        return [*row, "-"]
    ratio = global_.seconds[b - 1] / plain.seconds[-1 if a is None else a - 1]
    return [*row, f"{'<' if a is None else ''}{ratio:.2g}"]


def setups(name: str) -> list[str]:
    """The row of a problem: iterations of conjugate gradients, and the megabytes of each."""
    stated = PROBLEMS[name]()
    row = [name]
    for label, solver in MADE.items():
        made = solver.prepare(stated.system)
        run = made.begin(stated, stated.first_guess)
        A = made.matrix(made.stretched(run.positions)[1])
        prolongation = made.prolongation(A)
        if label == ALONE:
            prolongation.levels.clear()
        cycle = Cycle(A, prolongation)
        count = Solving(A, cycle, run.misfit, 1e-6).solve(2000)
        row.append(f"{count:,}, {1e-6 * (cycle.bytes + 12 * A.nnz):.1f}")
    return row


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--setup", action="store_true")
    parser.add_argument("names", nargs="*", default=list(PROBLEMS), metavar="PROBLEM")
    given = parser.parse_args()
    by = "to 1e-2, 1e-3, 1e-6"
    columns = (
        *("step", "springs", f"xpbd {by}", f"after {STALL}", "its error", f"mgpbd {by}", "its error"),
        *("linear iterations", "time, over xpbd's"),
    )
    table = Table(*(("step", *MADE) if given.setup else columns), box=SIMPLE_HEAD)
    with pinned_threads(1):
        for name in given.names:
            table.add_row(*(setups if given.setup else courses)(name))
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
