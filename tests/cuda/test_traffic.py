"""Bytes that an iteration must move, by formulas: near to what its launches are given."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import pytest

from solvers.cuda import device
from solvers.linear import schwarz
from solvers.methods.explicit import BlanesMoan4, RungeKutta4, VelocityVerlet
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.pncg import NonlinearCG
from solvers.methods.symplectic_euler import SymplecticEuler
from tests.scenes import cloth, first_problem

METHODS: dict[str, Callable[..., Any]] = {
    "pncg": lambda **on: NonlinearCG(preconditioner="block-jacobi", **on),
    "pncg, schwarz": lambda **on: NonlinearCG(preconditioner="schwarz", **on),
    "lbfgs": lambda **on: Lbfgs(preconditioner="a-jacobi", pairs=2, **on),
    "symplectic-euler": SymplecticEuler,
    "velocity-verlet": VelocityVerlet,
    "blanes-moan-4": BlanesMoan4,
    "runge-kutta-4": RungeKutta4,
}


def given(argument: Any) -> Iterator[int]:
    """Bytes of the arrays in an argument of a kernel."""
    if isinstance(argument, tuple):
        for part in argument:
            yield from given(part)
    elif getattr(argument, "shape", ()):
        yield argument.nbytes


@pytest.mark.skipif(not device.simulated(), reason="launches are seen in the simulator")
@pytest.mark.parametrize("name", METHODS)
def test_an_iteration_moves_about_what_its_launches_are_given(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what they are given, each array once, from a fifth to three fifths are not read: axes of dashpots and of
    springs without length, numbers of edges, other stages. What is read and written counts twice."""
    monkeypatch.setattr(schwarz, "PATCH", 4)
    problem = first_problem(cloth(8, "exact"))
    prepared = METHODS[name](device="cuda", precision="float64").prepare(problem.system)
    run = prepared.begin(problem, problem.first_guess)
    launched = list[int]()
    simulated: Any = import_module("numba.cuda.simulator.kernel").FakeCUDAKernel
    usual = simulated.__call__

    def call(self: Any, *arguments: Any) -> Any:
        if not self._device:
            launched.append(sum(given(arguments)))
        return usual(self, *arguments)

    monkeypatch.setattr(simulated, "__call__", call)
    run.launch(1)
    assert 0.4 < prepared.facts["sweep_bytes"] / sum(launched) < 0.8
