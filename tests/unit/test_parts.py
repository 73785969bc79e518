"""Quadratic forms as springs without length: the same value and force, and compiled as springs are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from scipy.sparse import csr_array

from harness.scenes.bind import Scene
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs as SpringsEffect
from harness.scenes.mesh.chain import Chain
from solvers.core.compiled import PreparedCompiled
from solvers.core.parts import split
from solvers.energies.quadratic import Quadratic
from solvers.energies.springs import Springs
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.local_global import SparseLocalGlobal
from solvers.methods.local_global_compiled import CompiledLocalGlobal
from solvers.problem import Positions, Solver, StepProblem, StopRule
from tests.effects import ATTACHED, BEND, DASHPOTS, DRAG, LIMITS, RAYLEIGH, cloth, stepped
from tests.scenes import scene
from tests.unit.test_xpbd import Other

EXACT = Pins.model_validate({"indices": [14, 33], "weight": "exact"})
SCENES: dict[str, Callable[[], Scene]] = {
    "bending": lambda: cloth(BEND),
    "bending beside exact pins": lambda: cloth(BEND, EXACT),
    "drag": lambda: cloth(DRAG),
    "attachments that move": lambda: cloth(ATTACHED),
    "all of them": lambda: cloth(BEND, DRAG, ATTACHED, EXACT),
    "strain limits": lambda: cloth(LIMITS, EXACT),
    "dashpots": lambda: cloth(DASHPOTS, EXACT),
    "all of these": lambda: cloth(BEND, DRAG, ATTACHED, LIMITS, DASHPOTS, RAYLEIGH, EXACT),
}
scenes = pytest.mark.parametrize("name", SCENES)


def iterates(solver: Solver, problem: StepProblem, count: int) -> list[Positions]:
    return [p.copy() for p in islice(solver.prepare(problem.system).iterates(problem), count)]


@pytest.mark.parametrize(
    "name",
    [name for name in SCENES if split(SCENES[name]().system).forms and not split(SCENES[name]().system).dashpots],
)
def test_forces_and_differences_of_value_are_those_of_the_energies(name):
    problem = stepped(SCENES[name]())
    s, rng = problem.system, np.random.default_rng(0)
    parts = split(s)
    forms = [energy for energy in problem.energies if isinstance(energy, Quadratic)]
    assert (len(forms), parts.unknown, parts.cancel) == (len(parts.forms), (), False)
    force = parts.force(problem) - problem.force
    p, q = problem.current + 0.1 * rng.normal(size=(2, *problem.current.shape))

    def value(x: Positions) -> float:
        pairs = parts.whole.value(x) - parts.springs.value(x)
        return pairs + 0.5 * float(parts.held @ np.sum(x**2, axis=1)) - float(np.sum(force * x))

    def gradient(energies, x: Positions) -> Positions:
        out = np.zeros_like(x)
        for energy in energies:
            energy.add_gradient(x, out)
        return out

    wanted = sum(energy.value(q) - energy.value(p) for energy in forms)
    size = sum(abs(energy.value(x)) for energy in forms for x in (p, q)) + np.abs(force).sum()
    assert abs(value(q) - value(p) - wanted) <= 1e-12 * size  # sums of some hundred terms
    found = gradient([parts.whole], p) - gradient([parts.springs], p) + parts.held[:, None] * p - force
    wanted = gradient(forms, p)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12 * (np.abs(wanted).max() + np.abs(force).max()))


@scenes
@pytest.mark.parametrize("linear", ["supernodal", "inverse"])
def test_compiled_iterates_are_those_of_the_sparse_backend(name, linear):
    problem = stepped(SCENES[name]())
    solver = CompiledLocalGlobal(linear)
    assert isinstance(solver.prepare(problem.system), PreparedCompiled)
    wanted, found = (iterates(one, problem, 20)[-1] for one in (SparseLocalGlobal(), solver))
    # Solves by pins of 1e10 N/m beside some hundred: so many of sixteen digits are lost at worst.
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)


@scenes
@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_less_precise_factors_end_where_float64_ends_and_descend(name, precision):
    problem = stepped(SCENES[name]())
    wanted = iterates(CompiledLocalGlobal(), problem, 6000)[-1]
    prepared = CompiledLocalGlobal("supernodal", precision).prepare(problem.system)
    value = problem.value(problem.first_guess)
    for p in islice(prepared.iterates(problem), 40):
        before, value = value, problem.value(p)
        assert value <= before + 1e-13 * problem.magnitude(p)  # a hundred terms
    found = prepared.solve(problem, StopRule(6000)).positions
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)  # what rates of convergence leave


@scenes
def test_a_compiled_step_is_the_step_with_calls_in_between(name):
    problem = stepped(SCENES[name]())
    compiled, called = (iterates(Lbfgs(linear=linear), problem, 8)[-1] for linear in ("supernodal", "cholespy"))
    # Two factors by the condition of Q, and windows that make ten times as much of it in each of some iterations.
    np.testing.assert_allclose(compiled, called, rtol=0, atol=1e-7)


@scenes
def test_residuals_are_those_of_the_sparse_backend(name):
    problem = stepped(SCENES[name]())
    found, wanted = (
        s.prepare(problem.system).solve(problem, StopRule(12, 1e-15))
        for s in (CompiledLocalGlobal(), SparseLocalGlobal())
    )
    assert found.residual == pytest.approx(wanted.residual, rel=1e-6)  # half of the digits, of squares of differences
    assert found.yardstick == pytest.approx(wanted.yardstick, rel=1e-6)


def test_other_energies_are_named():
    made = cloth(BEND, LIMITS, RAYLEIGH)
    assert split(made.system).unknown == ()
    assert split(replace(made.system, energies=(*made.system.energies, Other()))).unknown == ("Other",)


def test_springs_alone_are_taken_as_they_are():
    made = cloth()
    parts = split(made.system)
    assert parts.whole is parts.springs
    problem = stepped(made)
    assert parts.force(problem) is problem.force


def cancelling() -> StepProblem:
    """A chain of three, one of whose springs a form takes back from Q."""

    made = scene(Chain(), SpringsEffect(stretch=100.0), size=3)
    (one,) = made.system.energies
    assert isinstance(one, Springs)
    i, j = one.edges[0]
    A = np.zeros((1, 3))
    A[0, [i, j]] = 1.0  # w (x_i + x_j)^2 has w between them, where a spring has -k
    form = Quadratic(csr_array(A), one.stiffness[:1].copy(), np.zeros((1, 3)))
    return stepped(replace(made, system=replace(made.system, energies=(one, form))))


def test_where_a_form_and_a_spring_cancel_in_q_the_step_is_not_compiled_and_right():
    problem = cancelling()
    assert split(problem.system).cancel
    solver = CompiledLocalGlobal()
    assert not isinstance(solver.prepare(problem.system), PreparedCompiled)
    wanted, found = (iterates(one, problem, 30)[-1] for one in (SparseLocalGlobal(), solver))
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-12)  # a solve with three unknowns
