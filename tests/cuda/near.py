"""How near iterates on a device are to the processor's."""

from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from typing import Any, Literal

import numpy as np
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, StepProblem

PRECISIONS: tuple[Literal["float64", "float32"], ...] = ("float64", "float32")


def spacing(problem: StepProblem) -> float:
    """The mean length of springs at rest [m]."""
    return float(np.mean(Springs.from_parts([e for e in problem.energies if isinstance(e, Springs)]).rest_length))


def iterates(solver: Any, problem: StepProblem, count: int) -> list[Positions]:
    """The first of them, copied."""
    return [p.copy() for p in islice(solver.prepare(problem.system).iterates(problem), count)]


def same_iterates(method: Callable[..., Any], problem: StepProblem, count: int) -> None:
    """So many iterates on a device are the processor's: to 1e-10 m in float64, and in float32 to 1e-5 of the springs'
    mean length."""
    expected = iterates(method(), problem, count)
    for precision, close in zip(PRECISIONS, (1e-10, 1e-5 * spacing(problem)), strict=True):
        found = iterates(method(device="cuda", precision=precision), problem, count)
        np.testing.assert_allclose(found, expected, rtol=0, atol=close, err_msg=precision)
