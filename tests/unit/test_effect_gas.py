"""Gas against the closed form of a spherical membrane, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from springbench.harness.errors import InputError
from springbench.harness.reference.certified_minimum import certify_minimum
from springbench.harness.reference.hessian_curvature import build_free_hessian
from springbench.harness.scenes.effects.gas_effect import GasEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.surface_meshes import BalloonMesh
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.negative_curvature import is_positive_definite
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.energies import gas_energy
from springbench.solvers.model.step_problem import StepProblem, StopRule, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

from tests.effect_scenes import compute_rest_shape
from tests.scene_builders import build_first_problem, build_test_scene

RADIUS = 0.5
MESH = BalloonMesh(radius=RADIUS).build_mesh(3)


def build_gas(mesh=MESH, pressure=100.0) -> gas_energy.Gas:
    (energy,) = GasEffect(pressure=pressure).build_contribution(mesh, np.ones(len(mesh.rest_positions)), 0.1).energies
    assert isinstance(energy, gas_energy.Gas)
    return energy


@pytest.mark.parametrize("pressure", [50.0, 200.0, 500.0])
def test_a_balloon_swells_to_the_radius_of_a_membrane(pressure):
    """2 T / R = p0 (R0/R)^3 with the tension T = sqrt(3) k (R/R0 - 1) R0/R of a lattice of triangles of springs k.

    An isotropic strain e stores sqrt(3) k e^2 a unit of area: three springs a vertex, on sqrt(3)/2 h^2.
    """
    k = 100.0
    expected = brentq(lambda x: pressure * RADIUS / x - 2 * 3**0.5 * k * (x - 1), 1.0, 50.0)
    made = build_test_scene(BalloonMesh(radius=RADIUS), SpringsEffect(stretch=k), GasEffect(pressure=pressure), size=6)
    p = compute_rest_shape(made, Lbfgs(), iterations=2000)
    radius = np.linalg.norm(p - p.mean(axis=0), axis=1).mean()
    assert radius / RADIUS == pytest.approx(expected, rel=0.005)  # the mesh is inside the sphere, by less than this


def test_pressure_times_volume_stays_what_it_is_at_rest():
    energy = build_gas()
    for scale in (0.5, 1.0, 3.0):
        g = np.zeros_like(MESH.rest_positions)
        energy.add_gradient(scale * MESH.rest_positions, g)
        work = -np.sum(g * MESH.rest_positions)  # dE/ds = -p dV/ds = -3 p V / s
        assert work == pytest.approx(3 * 100.0 * energy.rest_volume / scale, rel=1e-12)


def test_the_volume_is_that_of_the_polyhedron_wherever_it_is():
    cube = np.array(list(np.ndindex(2, 2, 2)), float)
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = np.array([[f[0], f[i], f[i + 1]] for f in faces for i in (1, 2)])
    for shift in (0.0, 1e3):
        found = gas_energy.Gas(triangles, 1.0, 1.0).volume_at(2.0 * cube + shift)
        assert found == pytest.approx(8.0, rel=1e-11)  # sixteen digits, of which the shift takes three, cubed none


def test_gas_inside_out_has_no_finite_energy_and_is_pushed_outwards():
    energy = build_gas()
    out = np.zeros_like(MESH.rest_positions)
    flipped = -MESH.rest_positions
    assert energy.value(flipped) == np.inf
    energy.add_gradient(flipped, out)
    assert np.isfinite(out).all()
    swollen = energy.volume_at(flipped - 1e-3 * out / np.abs(out).max())
    assert swollen > energy.volume_at(flipped)


def test_a_mesh_turned_inside_out_is_turned_back():
    turned = replace(MESH, triangles=MESH.triangles[:, ::-1].copy())
    assert build_gas(turned).rest_volume == pytest.approx(build_gas().rest_volume, rel=1e-14)
    assert build_gas(turned).value(2.0 * MESH.rest_positions) < 0.0


def test_the_hessian_is_sparse_but_for_one_column():
    energy, p = build_gas(), 1.1 * MESH.rest_positions
    column = energy.low_rank_columns(p).ravel()
    sparse = energy.sparse_hessian(p)
    assert sparse.nnz <= 9 * (len(p) + 2 * len(MESH.springs))
    whole = energy.hessian(p).toarray()
    np.testing.assert_allclose(sparse.toarray() + np.outer(column, column), whole, atol=1e-12 * np.abs(whole).max())


def test_a_balloon_that_falls_into_nothing_stays_a_balloon():
    made = build_test_scene(
        BalloonMesh(),
        SpringsEffect(stretch=50.0),
        GravityEffect(),
        GasEffect(pressure=5.0),
        PinsEffect(parts=("pole_top",)),
        size=3,
    )
    energy = made.system.energies[1]
    assert isinstance(energy, gas_energy.Gas)
    for step in simulate_scene(made, prepare(made, Lbfgs()), StopRule(100, 1e-6), initial_guess="inertial", frames=20):
        assert energy.volume_at(step.positions) > 0.0


def test_a_method_that_needs_projective_energies_refuses_gas_by_name():
    made = build_test_scene(BalloonMesh(), SpringsEffect(stretch=50.0), GasEffect(pressure=5.0), size=2)
    with pytest.raises(Unsupported, match="Gas"):
        SparseLocalGlobal().prepare(made.system)


def without(k: int):
    return replace(MESH, triangles=np.delete(MESH.triangles, k, axis=0))


def flip_triangle(k: int):
    triangles = MESH.triangles.copy()
    triangles[k] = triangles[k, ::-1]
    return replace(MESH, triangles=triangles)


FLAT = replace(MESH, rest_positions=MESH.rest_positions * [1.0, 0.0, 1.0])
BAD = {
    "a chain": (ChainMesh().build_mesh(4), "no triangles"),
    "a sheet": (GridMesh().build_mesh(3), "8 edges belong to one triangle only"),
    "a hole": (without(5), "3 edges belong to one triangle only"),
    "a triangle that faces inwards": (flip_triangle(5), "two triangles traverse the edge in the same direction,"),
    "no volume": (FLAT, "encloses no volume"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mesh_that_is_not_closed_is_refused(case):
    mesh, message = BAD[case]
    with pytest.raises(InputError, match=message):
        build_gas(mesh)


def build_balloon_step(size: int, pressure: float) -> StepProblem:
    """A step of a balloon. At 200 Pa it swells to more than twice its radius: there the springs soften as it grows, and
    the gas preserves its volume, whose stiffness is the dense part of the Hessian."""
    made = build_test_scene(
        BalloonMesh(),
        SpringsEffect(stretch=5.0),
        GasEffect(pressure=pressure),
        PinsEffect(parts=("pole_top",)),
        size=size,
    )
    return build_first_problem(replace(made, system=replace(made.system, time_step=0.1)))


@pytest.mark.parametrize(
    "solver", [NewtonSolver(), HybridNewton(), NewtonCG(), Lbfgs()], ids=lambda solver: type(solver).__name__
)
def test_gas_is_minimised_where_its_sparse_part_alone_has_saddles(solver):
    given = build_balloon_step(4, 200.0)
    found = solver.prepare(given.system).solve(given, StopRule(2000, 1e-9))
    expected = NewtonSolver().prepare(given.system).solve(given, StopRule(100, 1e-12)).positions
    np.testing.assert_allclose(
        found.positions, expected, atol=1e-7
    )  # 1e-9 of the first step's length, over what is soft
    step = StepObjective(FixedObjective(given.system), given)
    H = build_free_hessian(given, expected)
    assert np.linalg.eigvalsh(H.sparse.toarray())[0] < -0.1 < 0.1 < np.linalg.eigvalsh(H.toarray())[0]
    assert is_positive_definite(step, expected)
    assert certify_minimum(given, expected).is_certified


@pytest.mark.parametrize("at_rest", [False, True])
@pytest.mark.parametrize("pressure", [2.0, 200.0])
def test_a_factor_of_gas_is_that_of_its_whole_hessian(pressure, at_rest):
    """Where the sparse part is definite, and where it is not; multiplied, solved, and distinguished from a saddle."""
    given = build_balloon_step(3, pressure)
    rest = NewtonSolver().prepare(given.system).solve(given, StopRule(100, 1e-12)).positions
    step, p = StepObjective(FixedObjective(given.system), given), rest if at_rest else given.current_positions
    hessian, free = step.hessian(p), given.system.free_vertices
    whole, b = build_free_hessian(given, p).toarray(), np.zeros_like(p)
    b[free] = np.random.default_rng(0).normal(size=(len(free), 3))
    product = (whole @ b[free].ravel()).reshape(-1, 3)
    np.testing.assert_allclose(hessian.matvec(b)[free], product, atol=1e-12 * np.abs(product).max())
    definite = np.linalg.eigvalsh(whole)[0] > 0.0
    assert hessian.factorise() == definite
    assert definite or (pressure == 200.0 and not at_rest)
    if definite:
        np.testing.assert_allclose(hessian.matvec(hessian.solve(b)), b, atol=1e-9)  # condition times round-off


def test_a_balloon_of_a_thousand_vertices_ends_at_a_certified_minimum():
    """1,212 vertices: a dense Hessian would have 13 million entries."""
    given = build_balloon_step(11, 200.0)
    assert given.system.num_vertices > 1000
    found = NewtonSolver().prepare(given.system).solve(given, StopRule(100, 1e-9))
    assert found.termination_reason == "converged"
    assert certify_minimum(given, found.positions).is_certified
