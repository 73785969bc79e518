"""Gas against the closed form of a spherical membrane, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from harness.base.errors import InputError
from harness.scenes.effects.gas import Gas
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.springs import Springs
from harness.scenes.mesh.chain import Chain
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.surfaces import Balloon
from harness.simulation.step import prepare, simulate
from solvers.energies import gas
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.local_global import SparseLocalGlobal
from solvers.problem import StopRule, Unsupported
from tests.effects import at_rest
from tests.scenes import scene

RADIUS = 0.5
MESH = Balloon(radius=RADIUS).build(3)


def bound(mesh=MESH, pressure=100.0) -> gas.Gas:
    (energy,) = Gas(pressure=pressure).bind(mesh, np.ones(len(mesh.rest)), 0.1).energies
    assert isinstance(energy, gas.Gas)
    return energy


@pytest.mark.parametrize("pressure", [50.0, 200.0, 500.0])
def test_a_balloon_swells_to_the_radius_of_a_membrane(pressure):
    """2 T / R = p0 (R0/R)^3 with the tension T = sqrt(3) k (R/R0 - 1) R0/R of a lattice of triangles of springs k.

    An isotropic strain e stores sqrt(3) k e^2 a unit of area: three springs a vertex, on sqrt(3)/2 h^2.
    """
    k = 100.0
    wanted = brentq(lambda x: pressure * RADIUS / x - 2 * 3**0.5 * k * (x - 1), 1.0, 50.0)
    made = scene(Balloon(radius=RADIUS), Springs(stretch=k), Gas(pressure=pressure), size=6)
    p = at_rest(made, Lbfgs(), iterations=2000)
    radius = np.linalg.norm(p - p.mean(axis=0), axis=1).mean()
    assert radius / RADIUS == pytest.approx(wanted, rel=0.005)  # the mesh is inside the sphere, by less than this


def test_pressure_times_volume_stays_what_it_is_at_rest():
    energy = bound()
    for scale in (0.5, 1.0, 3.0):
        g = np.zeros_like(MESH.rest)
        energy.add_gradient(scale * MESH.rest, g)
        work = -np.sum(g * MESH.rest)  # dE/ds = -p dV/ds = -3 p V / s
        assert work == pytest.approx(3 * 100.0 * energy.volume / scale, rel=1e-12)


def test_the_volume_is_that_of_the_polyhedron_wherever_it_is():
    cube = np.array(list(np.ndindex(2, 2, 2)), float)
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = np.array([[f[0], f[i], f[i + 1]] for f in faces for i in (1, 2)])
    for shift in (0.0, 1e3):
        found = gas.Gas(triangles, 1.0, 1.0).volume_at(2.0 * cube + shift)
        assert found == pytest.approx(8.0, rel=1e-11)  # sixteen digits, of which the shift takes three, cubed none


def test_gas_inside_out_has_no_finite_energy_and_is_pushed_outwards():
    energy = bound()
    out = np.zeros_like(MESH.rest)
    flipped = -MESH.rest
    assert energy.value(flipped) == np.inf
    energy.add_gradient(flipped, out)
    assert np.isfinite(out).all()
    swollen = energy.volume_at(flipped - 1e-3 * out / np.abs(out).max())
    assert swollen > energy.volume_at(flipped)


def test_a_mesh_turned_inside_out_is_turned_back():
    turned = replace(MESH, triangles=MESH.triangles[:, ::-1].copy())
    assert bound(turned).volume == pytest.approx(bound().volume, rel=1e-14)
    assert bound(turned).value(2.0 * MESH.rest) < 0.0


def test_the_dense_part_of_the_hessian_is_left_out_for_large_meshes(monkeypatch):
    energy = bound()
    full = energy.hessian(MESH.rest)
    monkeypatch.setattr(gas, "LARGEST_DENSE", len(MESH.rest) - 1)
    rest = energy.hessian(MESH.rest)
    assert rest.nnz < 0.2 * full.nnz
    dropped = (full - rest).toarray()
    assert np.linalg.matrix_rank(dropped, tol=1e-9 * np.abs(dropped).max()) == 1


def test_a_balloon_that_falls_into_nothing_stays_a_balloon():
    made = scene(Balloon(), Springs(stretch=50.0), Gravity(), Gas(pressure=5.0), Pins(at=("pole_top",)), size=3)
    energy = made.system.energies[1]
    assert isinstance(energy, gas.Gas)
    for step in simulate(made, prepare(made, Lbfgs()), StopRule(100, 1e-6), first_guess="inertial", frames=20):
        assert energy.volume_at(step.positions) > 0.0


def test_a_method_that_needs_projective_energies_refuses_gas_by_name():
    made = scene(Balloon(), Springs(stretch=50.0), Gas(pressure=5.0), size=2)
    with pytest.raises(Unsupported, match="Gas"):
        SparseLocalGlobal().prepare(made.system)


def without(k: int):
    return replace(MESH, triangles=np.delete(MESH.triangles, k, axis=0))


def flipped(k: int):
    triangles = MESH.triangles.copy()
    triangles[k] = triangles[k, ::-1]
    return replace(MESH, triangles=triangles)


FLAT = replace(MESH, rest=MESH.rest * [1.0, 0.0, 1.0])
BAD = {
    "a chain": (Chain().build(4), "no triangles"),
    "a sheet": (Grid().build(3), "8 edges belong to one triangle only"),
    "a hole": (without(5), "3 edges belong to one triangle only"),
    "a triangle that faces inwards": (flipped(5), "two triangles go the same way along the edge"),
    "no volume": (FLAT, "encloses no volume"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mesh_that_is_not_closed_is_refused(case):
    mesh, told = BAD[case]
    with pytest.raises(InputError, match=told):
        bound(mesh)
