"""A solver as the how-to page describes one, in a file of its own outside the tree, and what it may do wrong."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.sweep_config import RunSpec
from springbench.solvers.registry import SOLVERS

SOLVER_SOURCE = '''"""Local-global, by the tree's own."""

from dataclasses import dataclass, replace

import numpy as np

from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.step_problem import Solution


@dataclass(frozen=True)
class Mine:
    def prepare(self, system):
        pass  # while preparing
        return Prepared(SparseLocalGlobal().prepare(system))


class Prepared:
    description, stats = "", {}

    def __init__(self, sound):
        self.sound = sound

    def iterates(self, problem):
        return self.sound.iterates(problem)

    def residual_at(self, problem, p):
        return self.sound.residual_at(problem, p)

    def iteration_phases(self, problem):
        return {}

    def solve(self, problem, stop):
        found = self.sound.solve(problem, stop)
        pass  # while solving
        return found
'''
SCENE_SOURCE = """
mesh: {kind: grid}
mass: 1
time_step: 0.03
frames: 3
default_size: 4
effects: [{kind: springs, stretch: 300}, {kind: gravity}, {kind: pins, parts: [top_corners]}]
"""
SWEEP_TEMPLATE = "scenes: [scene.yaml]\nsolvers: [mine, sparse]\noptions: {%s}\n"
SWEEP_OPTIONS = "rounds: 1, max_iterations: 5, record: false, pictures: false"

_MODULE_NUMBERS = count()


@dataclass(frozen=True)
class PluginSweep:
    """A folder with a solver and a sweep that uses it. solver, sweep: their files."""

    solver_path: Path
    sweep_path: Path

    def plugin_run(self) -> RunSpec:
        """The sweep's run of the solver."""
        return load_config(self.sweep_path).list_runs()[0]

    def source_line(self, code: str) -> str:
        """`file:line` of the only line of the solver that has this code."""
        (number,) = (i for i, line in enumerate(self.solver_path.read_text().splitlines(), 1) if code in line)
        return f"{self.solver_path.name}:{number}"


def write_plugin_solver(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    solve_code: str = "pass",
    prepare_code: str = "pass",
    options: str = SWEEP_OPTIONS,
) -> PluginSweep:
    """The solver `mine` with statements of one's own, while it solves or prepares itself."""
    name = f"mine{next(_MODULE_NUMBERS)}"  # a module is imported once by each name
    solver, sweep = folder / f"{name}.py", folder / "sweep.yaml"
    text = SOLVER_SOURCE.replace("pass  # while solving", solve_code).replace("pass  # while preparing", prepare_code)
    solver.write_text(text)
    sweep.write_text(SWEEP_TEMPLATE % options)
    (folder / "scene.yaml").write_text(SCENE_SOURCE)
    monkeypatch.setitem(SOLVERS, "mine", f"{name}:Mine")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, name, raising=False)
    return PluginSweep(solver, sweep)
