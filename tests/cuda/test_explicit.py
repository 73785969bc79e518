"""Explicit methods on a device: the processor's frames, their velocities and the steps that they choose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np
import pytest

from solvers.cuda.run import DeviceIterative
from solvers.energies.springs import Springs
from solvers.methods.explicit import BlanesMoan4, BlanesMoan6, DormandPrince8, RungeKutta4, Tsitouras5, VelocityVerlet
from solvers.methods.symplectic_euler import SymplecticEuler
from solvers.problem import Pins, StepProblem, StopRule, System, Unsupported
from tests.cuda.near import PRECISIONS, spacing
from tests.effects import BEND, DASHPOTS, DRAG, stepped
from tests.effects import cloth as cloth_with
from tests.scenes import begun


def moving() -> StepProblem:
    """Four vertices in motion, one held exactly and one by penalty, and springs, of which one begins without length."""
    rng = np.random.default_rng(3)
    rest = rng.normal(size=(4, 3))
    edges = np.array([[0, 2], [1, 2], [2, 3], [0, 3]])
    springs = Springs.at_rest(rest, edges, rng.uniform(100.0, 1e3, 4))
    system = System(rng.uniform(1.0, 2.0, 4), 1 / 30, (springs,), Pins(np.arange(2), np.array([np.inf, 1e4])))
    here = rest.copy()
    here[3] = here[2]
    targets = here[:2] + 0.1 * rng.normal(size=(2, 3))
    target, force = here + 0.1 * rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    return StepProblem(system, target, force, targets, here, here, begun(system, target, here))


DEVICES: tuple[Literal["cpu", "cuda"], ...] = ("cpu", "cuda")

METHODS: dict[str, tuple[Callable[..., Any], Callable[[], StepProblem]]] = {
    "symplectic-euler": (SymplecticEuler, moving),
    "velocity-verlet, bending and drag": (VelocityVerlet, lambda: stepped(cloth_with(BEND, DRAG))),
    "velocity-verlet, refined": (lambda **on: VelocityVerlet(refine=3, **on), moving),
    "blanes-moan-4": (BlanesMoan4, moving),
    "blanes-moan-6": (BlanesMoan6, moving),
    "runge-kutta-4": (RungeKutta4, moving),
    "tsitouras-5": (lambda **on: Tsitouras5(error=1e-4, **on), moving),
    "dormand-prince-8": (lambda **on: DormandPrince8(error=1e-6, **on), moving),
}


@pytest.mark.parametrize(("method", "make"), METHODS.values(), ids=list(METHODS))
def test_frames_are_those_of_the_processor(method: Callable[..., Any], make: Callable[[], StepProblem]) -> None:
    problem, rule = make(), StopRule()
    wanted = method().prepare(problem.system).solve(problem, rule)
    frame = problem.system.time_step
    for precision, close in zip(PRECISIONS, (1e-10, 1e-5 * spacing(problem)), strict=True):
        prepared = method(device="cuda", precision=precision).prepare(problem.system)
        assert isinstance(prepared, DeviceIterative)
        found = prepared.solve(problem, rule)
        assert found.iterations == wanted.iterations == 1
        assert found.velocity is not None
        assert wanted.velocity is not None
        np.testing.assert_allclose(found.positions, wanted.positions, rtol=0, atol=close, err_msg=precision)
        np.testing.assert_allclose(found.velocity, wanted.velocity, rtol=0, atol=close / frame, err_msg=precision)


@pytest.mark.parametrize("method", [VelocityVerlet, Tsitouras5])
def test_bits_do_not_depend_on_who_looks(method: Callable[..., Any]) -> None:
    problem = moving()
    prepared = method(device="cuda").prepare(problem.system)
    found, again = prepared.solve(problem, StopRule()), prepared.replay(problem, 1)[0]
    np.testing.assert_array_equal(again.positions, found.positions)
    np.testing.assert_array_equal(again.velocity, found.velocity)
    np.testing.assert_array_equal(next(prepared.iterates(problem)), found.positions)


@pytest.mark.parametrize(("method", "tolerance"), [(Tsitouras5, 1e-5), (DormandPrince8, 1e-7)])
def test_it_takes_and_rejects_the_same_steps(method: Callable[..., Any], tolerance: float) -> None:
    """From a first one that is too long."""
    problem = moving()
    frame, on = problem.system.time_step, {"device": "cuda", "precision": "float64"}
    here, there = (method(**given).prepare(problem.system).within(tolerance) for given in ({}, on))
    p, v, told = here.step(problem, frame)
    q, w, also = there.step(problem, frame)
    assert told[1] > 0
    np.testing.assert_array_equal(also[:2], told[:2])
    # The frame's end cuts the last step short: its error, by which the next one is chosen, is near round-off.
    np.testing.assert_allclose(also[2], told[2], rtol=1e-2)
    np.testing.assert_allclose(q, p, rtol=0, atol=1e-10)
    np.testing.assert_allclose(w, v, rtol=0, atol=1e-10 / frame)
    assert (there.order, there.evaluations) == (here.order, here.evaluations)


def test_where_an_error_is_kept_by_no_step_it_says_so() -> None:
    problem = moving()
    prepared: Any = Tsitouras5(device="cuda").prepare(problem.system)
    with pytest.raises(RuntimeError, match=r"the error of 1e-300 m was not kept within \d+ steps"):
        prepared.within(1e-300).step(problem)


def test_more_substeps_are_those_of_the_processor() -> None:
    problem = moving()
    here, there = (
        cast("Any", VelocityVerlet(device=device).prepare(problem.system)).refined(2.5) for device in DEVICES
    )
    np.testing.assert_allclose(there.step(problem)[0], here.step(problem)[0], rtol=0, atol=1e-5 * spacing(problem))
    with pytest.raises(Unsupported, match="chooses no steps by an error"):
        there.within(1e-3)


def _massless(system: System) -> System:
    mass = system.mass.copy()
    mass[3] = 0.0
    return replace(system, mass=mass)


@pytest.mark.parametrize(
    ("method", "make", "named"),
    [
        (SymplecticEuler, lambda: cloth_with(BEND).system, "knows springs only; the scene has Bending"),
        (VelocityVerlet, lambda: cloth_with(DASHPOTS).system, "the scene has Dashpots as well"),
        (VelocityVerlet, lambda: _massless(moving().system), "moves each vertex by its own mass"),
    ],
    ids=["bending", "dashpots", "no mass"],
)
def test_what_it_cannot_do_it_refuses_as_the_processor_does(
    method: Callable[..., Any], make: Callable[[], System], named: str
) -> None:
    system = make()
    for on in ({}, {"device": "cuda"}):
        with pytest.raises(Unsupported, match=named):
            method(**on).prepare(system)
