"""Preconditioners of conjugate gradients: what each is, that it leads to the same minima, and which takes longer."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.sparse import bsr_array, csr_array
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.iteration.descent_method import PreparedDescent, ResidualMetric
from springbench.solvers.iteration.preconditioners import PreconditionerName, assemble_diagonal_blocks
from springbench.solvers.linalg.additive_schwarz import (
    SUBDOMAIN_SIZE,
    AdditiveSchwarz,
    SubdomainHierarchy,
    order_into_subdomains,
)
from springbench.solvers.methods.newton.negative_curvature import is_positive_definite
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.quasi_newton.nonlinear_cg import NonlinearCG
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import Hessian, StepObjective

from tests.effect_scenes import EFFECT_SCENES, build_moving_problem
from tests.scene_builders import build_cloth, build_first_problem, build_test_scene
from tests.unit.test_surface_contact import BALL, build_draped_sheet, contact, count_intersections

OTHERS: list[PreconditionerName] = [name for name in get_args(PreconditionerName) if name != "cholesky"]
others = pytest.mark.parametrize("name", OTHERS)
METHODS = {"newton-cg": NewtonCG, "pncg": NonlinearCG}


def build_preconditioner(
    size: int, stretch: float = 300.0
) -> tuple[csr_array, AdditiveSchwarz, NDArray[np.int64], NDArray[np.float64]]:
    """The clamped Hessian (3f, 3f) of a cloth that was disturbed, its S, the order, and its diagonal blocks."""
    stated = build_first_problem(build_cloth(size, "exact", stretch))
    step = StepObjective(FixedObjective(stated.system), stated)
    p = step.apply_exact_pins(
        stated.current_positions + 0.1 / size * np.random.default_rng(0).normal(size=stated.current_positions.shape)
    )
    matrix = step.hessian(p).assemble_clamped()
    order = order_into_subdomains(matrix.graph)
    bsr = bsr_array((matrix.values, matrix.graph.indices, matrix.graph.indptr))
    blocks = matrix.values[matrix.block_indices.diagonal_block[stated.system.free_vertices]]
    return csr_array(bsr), SubdomainHierarchy(matrix.graph, order).build_preconditioner(matrix.values), order, blocks


def by_levels(A: csr_array, order: NDArray[np.int64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The sum over levels of P B^-1 P' b, (3f, k), by its formula."""
    f = len(order)
    nodes, out = np.argsort(order), np.zeros_like(b)
    while True:
        of = (3 * nodes[:, None] + np.arange(3)).ravel()
        P = csr_array((np.ones(3 * f), (np.arange(3 * f), of)))
        M, r = csr_array(P.T @ csr_array(A @ P)).toarray(), np.asarray(P.T @ b)
        moved = np.zeros_like(r)
        for first in range(0, len(M), 3 * SUBDOMAIN_SIZE):
            some = slice(first, first + 3 * SUBDOMAIN_SIZE)
            moved[some] = np.linalg.solve(M[some, some], r[some])
        out += P @ moved
        if len(M) <= 3 * SUBDOMAIN_SIZE:
            return out
        nodes = nodes // SUBDOMAIN_SIZE


@pytest.mark.parametrize(("size", "levels"), [(4, 1), (12, 2), (33, 3)])
def test_schwarz_is_the_sum_of_its_levels(size, levels):
    A, S, order, _ = build_preconditioner(size)
    assert len(S.subdomain_inverses) == levels
    np.testing.assert_array_equal(np.sort(order), np.arange(len(order)))
    b = np.random.default_rng(1).normal(size=(len(order), 3))
    expected = by_levels(A, order, b.reshape(-1, 1)).reshape(-1, 3)
    np.testing.assert_allclose(S.apply_preconditioner(b), expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def whole(S: AdditiveSchwarz, f: int) -> NDArray[np.float64]:
    """S as a dense matrix (3f, 3f)."""
    return np.column_stack([S.apply_preconditioner(unit.reshape(-1, 3)).ravel() for unit in np.eye(3 * f)])


def condition(A: NDArray[np.float64], S: NDArray[np.float64]) -> float:
    """Of S A, whose eigenvalues are those of L'S L, A = L L'."""
    L = np.linalg.cholesky(A)
    size = np.linalg.eigvalsh(L.T @ S @ L)
    return float(size[-1] / size[0])


def test_schwarz_is_symmetric_positive_definite_and_better_than_blocks_on_stiff_cloth():
    A, S, order, blocks = build_preconditioner(12, 1e5)
    found, dense = whole(S, len(order)), A.toarray()
    np.testing.assert_allclose(found, found.T, rtol=0, atol=1e-12 * np.abs(found).max())
    assert np.linalg.eigvalsh(found).min() > 0.0
    jacobi = block_diag(*np.linalg.inv(blocks))
    assert condition(dense, found) < 0.5 * condition(dense, jacobi)


def test_patches_are_of_neighbours():
    """Most of a cloth's neighbours are in the same patch, whatever parts it has, and all vertices are in one."""
    graph = metric(33).free_block
    for some in (graph, csr_array(block_diag(graph.toarray(), np.eye(70), graph.toarray()[:40, :40]))):
        order, ends = order_into_subdomains(some), some.tocoo()
        np.testing.assert_array_equal(np.sort(order), np.arange(len(order)))
        place = np.argsort(order) // SUBDOMAIN_SIZE
        apart = ends.row != ends.col
        assert (place[ends.row] == place[ends.col])[apart].mean() > 0.6


def metric(size: int) -> ResidualMetric:
    return ResidualMetric(build_first_problem(build_cloth(size, "exact")).system)


def build_effect_step(scene: str) -> StepProblem:
    return build_moving_problem(EFFECT_SCENES[scene]())


@pytest.mark.parametrize("scene", [s for s in EFFECT_SCENES if "gas" not in s])
def test_diagonal_blocks_are_those_of_the_clamped_matrix(scene):
    stated = build_effect_step(scene)
    step = StepObjective(FixedObjective(stated.system), stated)
    p = step.apply_exact_pins(stated.current_positions)
    hessian = step.hessian(p)
    matrix = hessian.assemble_clamped()
    expected = matrix.values[matrix.block_indices.diagonal_block[stated.system.free_vertices]]
    np.testing.assert_allclose(
        assemble_diagonal_blocks(step, hessian, p), expected, rtol=0, atol=1e-12 * np.abs(expected).max()
    )


@others
@pytest.mark.parametrize("method", METHODS)
def test_the_minimum_is_that_of_newtons_method(method, name):
    stated = build_effect_step("all that are projective")
    expected = NewtonSolver().prepare(stated.system).solve(stated, StopRule(200)).positions
    solution = METHODS[method](preconditioner=name).prepare(stated.system).solve(stated, StopRule(3000, 1e-9))
    assert solution.termination_reason != "max-iter"
    np.testing.assert_allclose(solution.positions, expected, rtol=0, atol=1e-7)


@others
def test_a_body_on_a_floor_is_at_a_minimum(name):
    """Which of them, friction leaves to the way there."""
    stated = build_effect_step("contact")
    p = NewtonCG(preconditioner=name).prepare(stated.system).solve(stated, StopRule(500, 1e-9)).positions
    assert np.abs(stated.gradient(p)).max() <= 1e-6 * np.abs(stated.gradient(stated.current_positions)).max()
    step = StepObjective(FixedObjective(stated.system), stated)
    assert is_positive_definite(step, step.apply_exact_pins(p))


@pytest.mark.parametrize(("method", "name"), [*(("newton-cg", name) for name in OTHERS), ("pncg", "block-jacobi")])
def test_a_sheet_on_a_ball_is_supported_by_it(method, name):
    made = build_draped_sheet(BALL, size=6)
    rule, ends = StopRule(2000, 1e-8), list[Positions]()
    for solver in (NewtonSolver(), METHODS[method](preconditioner=name)):
        *_, last = simulate_scene(made, prepare(made, solver), rule, initial_guess="previous", frames=9)
        assert count_intersections(made, last.positions, made.compute_time(last.index)) == 0
        assert last.solution.termination_reason != "max-iter"
        ends.append(last.positions)
    assert contact(made).hessian_blocks(ends[0]).vertices.size
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-6)


def products(prepared: PreparedDescent, stated: StepProblem, monkeypatch: pytest.MonkeyPatch) -> int:
    """With the Hessian, in a solve to 1e-6."""
    count, multiply = [0], Hessian.matvec

    def counting(self: Hessian, x: Positions) -> Positions:
        count[0] += 1
        return multiply(self, x)

    with monkeypatch.context() as patched:
        patched.setattr(Hessian, "matvec", counting)
        assert prepared.solve(stated, StopRule(500, 1e-6)).termination_reason == "converged"
    return count[0]


def test_schwarz_takes_fewer_iterations_of_conjugate_gradients_than_blocks_on_stiff_cloth(monkeypatch):
    stated = build_first_problem(build_cloth(24, "exact", 1e5))
    found: dict[str, int] = {}
    for name in OTHERS:
        prepared = NewtonCG(preconditioner=name).prepare(stated.system)
        assert isinstance(prepared, PreparedDescent)
        found[name] = products(prepared, stated, monkeypatch)
    assert found["schwarz"] < 0.5 * found["block-jacobi"]


@pytest.mark.parametrize("method", METHODS)
@others
def test_energies_without_elements_are_refused_by_name(method, name):
    stated = build_effect_step("gas")
    with pytest.raises(Unsupported, match=f"{method}, preconditioner: {name}.*Gas.*take preconditioner: cholesky"):
        METHODS[method](preconditioner=name).prepare(stated.system)


def test_nothing_is_solved_for_where_all_vertices_are_pinned():
    stated = build_first_problem(
        build_test_scene(ChainMesh(), SpringsEffect(stretch=1.0), PinsEffect(parts=("ends",), weight="exact"), size=2)
    )
    for name in OTHERS:
        solution = NewtonCG(preconditioner=name).prepare(stated.system).solve(stated, StopRule(3))
        np.testing.assert_array_equal(solution.positions, stated.current_positions)


def test_blocks_take_the_memory_of_local_global():
    """Nothing looks for the structure of a Hessian's factor."""
    stated = build_first_problem(build_cloth(6, "exact"))
    prepared = NewtonCG(preconditioner="block-jacobi").prepare(stated.system)
    assert isinstance(prepared, PreparedDescent)
    prepared.solve(stated, StopRule(2))
    for phase in prepared.iteration_phases(stated).values():
        phase()
    assert "matrix" not in vars(prepared.fixed_objective)
