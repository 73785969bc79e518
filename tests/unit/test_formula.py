"""Solvers of one formula: a message on a wrong one names its file and line; their files run without `__file__`."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Callable
from dataclasses import make_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.solvers.methods.local_global.fixed_point import FixedPointSolver
from springbench.solvers.model.step_problem import PluginContractError, StopRule

from tests.scene_builders import build_cloth, build_first_problem

ROOT = Path(__file__).resolve().parents[2]

WRONG: dict[str, tuple[Callable[..., Any], str]] = {
    "nothing": (lambda self, p, before, correction: None, "gave a NoneType; expected float64 of shape"),
    "two coordinates": (lambda self, p, before, correction: p[:, :2], r"gave float64 of shape \(\d+, 2\); expected"),
    "single precision": (lambda self, p, before, correction: p.astype(np.float32), "gave float32 of shape"),
    "too few arguments": (lambda self, p, before: p, "should take p, before and correction"),
}


def solver_with(**methods: Any) -> Any:
    return make_dataclass("Wrong", [], bases=(FixedPointSolver,), namespace=methods, frozen=True)


@pytest.mark.parametrize("name", WRONG)
def test_a_formula_with_a_wrong_result_is_named_with_its_line(name: str):
    wrong, words = WRONG[name]
    line = inspect.getsourcelines(wrong)[1]
    stated = build_first_problem(build_cloth(4))
    with pytest.raises(PluginContractError, match=rf"test_formula\.py:{line}: `next_iterate` {words}"):
        solver_with(next_iterate=wrong)().prepare(stated.system).solve(stated, StopRule(3))


def test_a_class_without_a_formula_is_reported():
    with pytest.raises(TypeError, match="next_iterate"):
        solver_with()()


@pytest.mark.long
@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_an_example_runs_in_a_notebook_which_has_no_file(path: Path):
    cell = f"exec(compile(open({str(path)!r}).read(), '<cell>', 'exec'), {{'__name__': '__main__'}})"
    done = subprocess.run([sys.executable, "-c", cell], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
