"""Quadratic forms as springs without length: the same value and force, and compiled as springs are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.kernels.spring_local_step import SpringPackets
from springbench.solvers.kernels.spring_objective import ObjectiveWeights
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.fused_local_global import PreparedCompiledLocalGlobal
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.energies.quadratic_energy import Quadratic
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, Solver, StepProblem, StopRule
from springbench.solvers.objective.spring_form import decompose_energies
from springbench.solvers.simd.spring_descent import spring_energy_and_descent

from tests.effect_scenes import (
    AIR_DRAG_EFFECT,
    ATTACHMENT_EFFECT,
    BENDING_EFFECT,
    DASHPOT_EFFECT,
    RAYLEIGH_EFFECT,
    STRAIN_LIMIT_EFFECT,
    build_effect_cloth,
    build_moving_problem,
)
from tests.scene_builders import build_test_scene
from tests.unit.test_xpbd import Other

EXACT = PinsEffect.model_validate({"indices": [14, 33], "weight": "exact"})
SCENES: dict[str, Callable[[], Scene]] = {
    "bending": lambda: build_effect_cloth(BENDING_EFFECT),
    "bending with exact pins": lambda: build_effect_cloth(BENDING_EFFECT, EXACT),
    "drag": lambda: build_effect_cloth(AIR_DRAG_EFFECT),
    "attachments that move": lambda: build_effect_cloth(ATTACHMENT_EFFECT),
    "all of them": lambda: build_effect_cloth(BENDING_EFFECT, AIR_DRAG_EFFECT, ATTACHMENT_EFFECT, EXACT),
    "strain limits": lambda: build_effect_cloth(STRAIN_LIMIT_EFFECT, EXACT),
    "dashpots": lambda: build_effect_cloth(DASHPOT_EFFECT, EXACT),
    "all of these": lambda: build_effect_cloth(
        BENDING_EFFECT, AIR_DRAG_EFFECT, ATTACHMENT_EFFECT, STRAIN_LIMIT_EFFECT, DASHPOT_EFFECT, RAYLEIGH_EFFECT, EXACT
    ),
}
scenes = pytest.mark.parametrize("name", SCENES)


def iterates(solver: Solver, problem: StepProblem, count: int) -> list[Positions]:
    return [p.copy() for p in islice(solver.prepare(problem.system).iterates(problem), count)]


@pytest.mark.parametrize(
    "name",
    [
        name
        for name in SCENES
        if decompose_energies(SCENES[name]().system).form_builders
        and not decompose_energies(SCENES[name]().system).dashpots
    ],
)
@pytest.mark.parametrize("field", ["springs_and_forms", "joined_pairs"])
def test_forces_and_differences_of_value_are_those_of_the_energies(name, field):
    problem = build_moving_problem(SCENES[name]())
    s, rng = problem.system, np.random.default_rng(0)
    parts = decompose_energies(s)
    forms = [energy for energy in problem.energies if isinstance(energy, Quadratic)]
    assert (len(forms), parts.unsupported_energies, parts.has_cancellation) == (len(parts.form_builders), (), False)
    force, whole = parts.compute_force(problem) - problem.external_force, getattr(parts, field)
    p, q = problem.current_positions + 0.1 * rng.normal(size=(2, *problem.current_positions.shape))

    def value(x: Positions) -> float:
        pairs = whole.value(x) - parts.springs.value(x)
        return pairs + 0.5 * float(parts.vertex_weight @ np.sum(x**2, axis=1)) - float(np.sum(force * x))

    def gradient(energies, x: Positions) -> Positions:
        out = np.zeros_like(x)
        for energy in energies:
            energy.add_gradient(x, out)
        return out

    expected = sum(energy.value(q) - energy.value(p) for energy in forms)
    size = sum(abs(energy.value(x)) for energy in forms for x in (p, q)) + np.abs(force).sum()
    assert abs(value(q) - value(p) - expected) <= 1e-12 * size  # sums of some hundred terms
    found = gradient([whole], p) - gradient([parts.springs], p) + parts.vertex_weight[:, None] * p - force
    expected = gradient(forms, p)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * (np.abs(expected).max() + np.abs(force).max()))


def test_a_spring_and_a_pair_between_the_same_vertices_are_one():
    parts = decompose_energies(build_effect_cloth(BENDING_EFFECT).system)
    pairs = [
        {frozenset(map(int, edge)) for edge in part.edges} for part in (parts.springs_and_forms, parts.joined_pairs)
    ]
    assert pairs[0] == pairs[1]
    assert len(pairs[1]) == len(parts.joined_pairs.edges) < len(parts.springs_and_forms.edges)


def test_edges_in_the_norm_of_q_are_one_with_the_springs_between_the_same_vertices():
    system = build_effect_cloth(STRAIN_LIMIT_EFFECT, DASHPOT_EFFECT, RAYLEIGH_EFFECT).system
    parts, n = decompose_energies(system), system.num_vertices
    assert len(parts.system_pairs.edges) == len(parts.springs.edges)
    expected = csr_array((n, n))
    for energy in (parts.springs, *parts.strain_limits, *parts.dashpots):
        expected = expected + energy.stiffness_matrix(n)
    assert abs(parts.system_pairs.stiffness_matrix(n) - expected).max() <= 1e-12 * expected.max()


def test_a_negative_energy_of_a_packet_is_no_short_spring():
    """A pair of negative stiffness leaves the packet's energy negative; its vectors give it nevertheless."""
    pair = Springs(np.array([[0, 1]]), np.array([-2.0]), np.zeros(1), np.eye(3)[:1])
    packets, _ = SpringPackets.from_springs(pair, np.arange(2), np.zeros(2, np.int64), 1, 2, 3)
    weights = ObjectiveWeights.from_packets(packets, np.zeros(4), np.empty(0, np.int64))
    x, right = allocate_aligned(16), packets.build_right_hand_side(np.zeros(4))
    x[:8], x[12] = [3.0, 0.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0], 1e100
    value = np.empty(1)

    def evaluate(packets, weights, x, right, out, value):
        value[0] = spring_energy_and_descent(packets, weights, 0, x, right, out)

    jit_kernel(evaluate)(packets, weights, x, right, np.empty(16), value)
    assert value[0] == pytest.approx(pair.value(x.reshape(-1, 4)[:2, :3])) == -25.0


@scenes
@pytest.mark.parametrize("linear", ["supernodal", "inverse"])
def test_compiled_iterates_are_those_of_the_sparse_backend(name, linear):
    problem = build_moving_problem(SCENES[name]())
    solver = CompiledLocalGlobal(linear)
    assert isinstance(solver.prepare(problem.system), PreparedCompiledLocalGlobal)
    expected, found = (iterates(one, problem, 20)[-1] for one in (SparseLocalGlobal(), solver))
    # Solves with pins of 1e10 N/m among some hundred lose as many of sixteen digits at worst.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@scenes
@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_less_precise_factors_end_where_float64_ends_and_descend(name, precision):
    problem = build_moving_problem(SCENES[name]())
    expected = iterates(CompiledLocalGlobal(), problem, 6000)[-1]
    prepared = CompiledLocalGlobal("supernodal", precision).prepare(problem.system)
    value = problem.value(problem.initial_guess)
    for p in islice(prepared.iterates(problem), 40):
        before, value = value, problem.value(p)
        assert value <= before + 1e-13 * problem.value_scale(p)  # a hundred terms
    found = prepared.solve(problem, StopRule(6000)).positions
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)  # what rates of convergence leave


@scenes
def test_a_compiled_step_is_the_step_with_calls_in_between(name):
    problem = build_moving_problem(SCENES[name]())
    compiled, called = (iterates(Lbfgs(linear_solver=linear), problem, 8)[-1] for linear in ("supernodal", "cholespy"))
    # Two factors by the condition of Q, and windows that make ten times as much of it in each of some iterations.
    np.testing.assert_allclose(compiled, called, rtol=0, atol=1e-7)


@scenes
def test_residuals_are_those_of_the_sparse_backend(name):
    problem = build_moving_problem(SCENES[name]())
    found, expected = (
        s.prepare(problem.system).solve(problem, StopRule(12, 1e-15))
        for s in (CompiledLocalGlobal(), SparseLocalGlobal())
    )
    assert found.residual == pytest.approx(expected.residual, rel=1e-6)  # half of the digits, of squares of differences
    assert found.initial_residual == pytest.approx(expected.initial_residual, rel=1e-6)


def test_other_energies_are_named():
    made = build_effect_cloth(BENDING_EFFECT, STRAIN_LIMIT_EFFECT, RAYLEIGH_EFFECT)
    assert decompose_energies(made.system).unsupported_energies == ()
    assert decompose_energies(replace(made.system, energies=(*made.system.energies, Other()))).unsupported_energies == (
        "Other",
    )


def test_springs_alone_are_taken_as_they_are():
    made = build_effect_cloth()
    parts = decompose_energies(made.system)
    assert parts.springs_and_forms is parts.springs
    problem = build_moving_problem(made)
    assert parts.compute_force(problem) is problem.external_force


def cancelling() -> StepProblem:
    """A chain of three, one of whose springs a form takes back from Q."""

    made = build_test_scene(ChainMesh(), SpringsEffect(stretch=100.0), size=3)
    (one,) = made.system.energies
    assert isinstance(one, Springs)
    i, j = one.edges[0]
    A = np.zeros((1, 3))
    A[0, [i, j]] = 1.0  # w (x_i + x_j)^2 has w between them, where a spring has -k
    form = Quadratic(csr_array(A), one.stiffness[:1].copy(), np.zeros((1, 3)))
    return build_moving_problem(replace(made, system=replace(made.system, energies=(one, form))))


def test_where_a_form_and_a_spring_cancel_in_q_the_step_is_not_compiled_and_right():
    problem = cancelling()
    assert decompose_energies(problem.system).has_cancellation
    solver = CompiledLocalGlobal()
    assert not isinstance(solver.prepare(problem.system), PreparedCompiledLocalGlobal)
    expected, found = (iterates(one, problem, 30)[-1] for one in (SparseLocalGlobal(), solver))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)  # a solve with three unknowns
