"""Vertex block descent with energies of elements: each vertex's own share of them, descent, and what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.vertex_block.incident_elements import ElementKind, VertexFunctions
from springbench.solvers.methods.vertex_block.vbd import PreparedVertexBlockDescent, VertexBlockDescent
from springbench.solvers.methods.vertex_block.vertex_elements import VertexElements
from springbench.solvers.model.energies.dashpot_energy import Dashpots
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits
from springbench.solvers.model.step_problem import StopRule, Unsupported

from tests.effect_scenes import (
    BENDING_EFFECT,
    DASHPOT_EFFECT,
    EFFECT_SCENES,
    FLOOR_CONTACT,
    RAYLEIGH_EFFECT,
    STRAIN_LIMIT_EFFECT,
    build_effect_cloth,
    build_moving_problem,
)

METHODS = {"plain": VertexBlockDescent(0.0), "accelerated": VertexBlockDescent()}
EFFECTS = {
    "strain limits": (STRAIN_LIMIT_EFFECT,),
    "dashpots": (DASHPOT_EFFECT,),
    "rayleigh": (RAYLEIGH_EFFECT, BENDING_EFFECT),
    "both, and contact": (STRAIN_LIMIT_EFFECT, DASHPOT_EFFECT, FLOOR_CONTACT),
}
NOISE = np.random.default_rng(0)


def energy_index(energies: Sequence[Any]) -> int:
    """The index of strain limits or dashpots, which the packets of springs take as well as elements by vertex."""
    return next(k for k, energy in enumerate(energies) if isinstance(energy, (StrainLimits, Dashpots)))


@pytest.mark.parametrize("effect", ["strain limits", "dashpots"])
def test_the_force_on_a_vertex_is_that_of_the_reference_evaluator(effect):
    """Value, gradient, diagonal blocks of the Hessian, and the rise by a step of one vertex."""
    problem = build_moving_problem(build_effect_cloth(*EFFECTS[effect]))
    n = problem.system.num_vertices
    p, d = problem.current_positions, 0.01 * NOISE.normal(size=(n, 3))
    other = VertexElements(problem.system, (energy_index(problem.system.energies),))
    around = other.with_rows(np.arange(n), n).update_elements(problem)
    energy: Any = problem.energies[other.energy_indices[0]]
    total, felt, risen = VertexFunctions.from_kinds([ElementKind(energy.element_law, 2)])

    def evaluate_vertex(around, p, d, gradient, block, rises, value):
        value[0] = total(around, p)
        for i in range(len(rises)):
            gradient[i], block[i] = felt(around, i, p, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
            rises[i] = risen(around, i, p, (d[i, 0], d[i, 1], d[i, 2]))

    gradient, block, rises, value = (np.empty(shape) for shape in ((n, 3), (n, 6), n, 1))
    jit_kernel(evaluate_vertex)(around, np.pad(p, ((0, 0), (0, 1))).ravel(), d, gradient, block, rises, value)
    expected = np.zeros_like(p)
    energy.add_gradient(p, expected)
    blocks = energy.hessian(p).toarray().reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(value[0], energy.value(p), rtol=1e-12)
    np.testing.assert_allclose(gradient, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(block, blocks[:, *np.triu_indices(3)], atol=1e-12 * np.abs(blocks).max())
    for i in range(n):
        moved = p.copy()
        moved[i] += d[i]
        assert rises[i] == pytest.approx(energy.value(moved) - energy.value(p), abs=1e-12 * energy.value(p))


@pytest.mark.parametrize("method", METHODS.values(), ids=list(METHODS))
@pytest.mark.parametrize("effect", EFFECTS)
def test_no_iteration_raises_the_objective_and_the_end_is_newtons_minimum(method, effect):
    problem = build_moving_problem(build_effect_cloth(*EFFECTS[effect]))
    prepared = method.prepare(problem.system)
    tangle = replace(problem, initial_guess=NOISE.normal(size=problem.current_positions.shape))
    one_point = replace(problem, initial_guess=np.zeros_like(problem.current_positions))
    for given in (problem, tangle, one_point):
        path = [p.copy() for p in islice(prepared.iterates(given), 40)]
        for before, after in pairwise(path):
            assert given.value(after) <= given.value(before) + 1e-13 * given.value_scale(before)  # a hundred terms
    expected = NewtonSolver().prepare(problem.system).solve(problem, StopRule(100, 1e-12)).positions
    near = replace(problem, initial_guess=expected + 1e-3 * NOISE.normal(size=expected.shape))
    found = prepared.solve(near, StopRule(4000)).positions
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)  # what a linear rate leaves
    assert np.array_equal(found, method.prepare(problem.system).solve(near, StopRule(4000)).positions)


def test_vertices_of_one_element_have_different_colours():
    """Elements that join vertices which no spring joins."""
    problem = build_moving_problem(build_effect_cloth(DASHPOT_EFFECT))
    system = problem.system
    damped = [energy for energy in system.energies if isinstance(energy, Dashpots)]
    far = [
        replace(energy, edges=np.array([[0, 35], [5, 30]]), stiffness=energy.stiffness[:2], offset=energy.offset[:2],
                direction=energy.direction[:2])
        for energy in damped
    ]  # fmt: skip
    apart = replace(system, energies=(*(e for e in system.energies if e not in damped), *far))
    made = VertexBlockDescent().prepare(apart)
    assert isinstance(made, PreparedVertexBlockDescent)
    packet = {int(place) // 4: k // 8 for k, place in enumerate(made.colour_packets.spring_packets.row_offset)}
    assert all(packet[int(made.row_of_vertex[i])] != packet[int(made.row_of_vertex[j])] for i, j in ((0, 35), (5, 30)))


def test_an_energy_without_a_bound_on_its_curvature_is_refused_with_that_reason():
    with pytest.raises(Unsupported, match="Gas has no element-wise projective form"):
        VertexBlockDescent().prepare(EFFECT_SCENES["gas"]().system)
