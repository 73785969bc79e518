"""Limits with a closed form: the elastic catenary (Irvine 1981, Cable Structures, section 1.3), the inextensible one.

A cable of unstretched length L, weight per length w and stiffness EA hangs between two supports. At the unstretched
length s its tension is (H, V(s)) with V(s) = V0 + w s, and

    x(s) = H s / EA + H / w (asinh(V(s) / H) - asinh(V0 / H))
    y(s) = (V0 s + w s^2 / 2) / EA + 1 / w (sqrt(H^2 + V(s)^2) - sqrt(H^2 + V0^2))

A chain whose vertices carry the weight of half a link to each side has at the middle of every link the cable's tension:
it is the midpoint rule, of order 2 in the links. At EA = inf the first terms vanish. Equilibrium is one step so long
that inertia weighs nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import root
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import DirichletPins, Positions, Solver, StepProblem, StopRule, System

from tests.scene_builders import build_step_start

LENGTH, WEIGHT = 2.0, 10.0
"""Of the whole cable [m], [N]."""
G, STEP = 9.81, 1e6
TO_THE_END = StopRule(2000)
SUPPORTS = {"level": (1.2, 0.0), "on a slope": (1.0, 0.7)}
"""Where the right support is from the left one [m]."""

solvers = pytest.mark.parametrize("solver", [NewtonSolver(), HybridNewton()], ids=lambda s: type(s).__name__)
supports = pytest.mark.parametrize("support", SUPPORTS.values(), ids=list(SUPPORTS))

Shape = Callable[[np.ndarray], np.ndarray]
"""(H, V0) [N] -> where the vertices are, (n, 2) [m]."""


def solve_hanging_shape(shape: Shape, support: tuple[float, float]) -> np.ndarray:
    """The shape whose last vertex is at the support."""
    found = root(lambda ends: shape(ends)[-1] - support, [0.3 * WEIGHT, -0.5 * WEIGHT], tol=1e-14)
    assert np.abs(shape(found.x)[-1] - support).max() <= 1e-13 * LENGTH, found.message
    return shape(found.x)


def cable(n: int, EA: float) -> Shape:
    """The closed form at n points, evenly spaced along the unstretched cable."""
    s, w = np.linspace(0.0, LENGTH, n), WEIGHT / LENGTH

    def shape(ends: np.ndarray) -> np.ndarray:
        H, V0 = ends
        V = V0 + w * s
        x = H * s / EA + H / w * (np.arcsinh(V / H) - np.arcsinh(V0 / H))
        y = (V0 * s + 0.5 * w * s**2) / EA + (np.hypot(H, V) - np.hypot(H, V0)) / w
        return np.stack([x, y], axis=1)

    return shape


def links(n: int) -> Shape:
    """n - 1 links of fixed length, the weight of half a link to each side at the vertices."""
    r, w = LENGTH / (n - 1), WEIGHT / (n - 1)

    def shape(ends: np.ndarray) -> np.ndarray:
        H, V0 = ends
        tension = np.stack([np.full(n - 1, H), V0 + w * (0.5 + np.arange(n - 1))], axis=1)
        steps = r * tension / np.linalg.norm(tension, axis=1)[:, None]
        return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    return shape


def equilibrium(n: int, EA: float, support: tuple[float, float], solver: Solver) -> np.ndarray:
    """Where a chain of n vertices comes to rest, (n, 2) [m], from a bow between its supports."""
    along = np.linspace(0.0, 1.0, n)[:, None]
    rest: Positions = np.zeros((n, 3))
    rest[:, :1] = LENGTH * along
    springs = Springs.from_rest_shape(rest, np.stack([np.arange(n - 1), np.arange(1, n)], axis=1), np.full(n - 1, EA))
    springs = Springs(
        springs.edges, springs.stiffness / springs.rest_length, springs.rest_length, springs.rest_direction
    )
    mass = np.full(n, WEIGHT / G / (n - 1))
    mass[[0, -1]] *= 0.5
    system = System(mass, STEP, (springs,), DirichletPins(np.array([0, n - 1]), np.full(2, np.inf)))
    end = np.array([*support, 0.0])
    bow = along * end - [0.0, 0.5 * LENGTH, 0.0] * np.sin(np.pi * along)
    bow[-1] = end
    force = mass[:, None] * [0.0, -G, 0.0]
    problem = StepProblem(system, bow, force, bow[[0, -1]], bow, bow, build_step_start(system, bow, bow))
    solution = solver.prepare(system).solve(problem, TO_THE_END)
    assert solution.termination_reason == "stalled"
    # Nothing pulls it out of its plane but round-off, where Newton's method looks for a way down.
    np.testing.assert_allclose(solution.positions[:, 2], 0.0, rtol=0, atol=1e-12 * LENGTH)
    return solution.positions[:, :2]


def orders(sizes: list[float], errors: list[float]) -> list[float]:
    """The exponents of the error between neighbouring sizes."""
    return [np.log(b / a) / np.log(s / r) for (a, b), (r, s) in zip(pairwise(errors), pairwise(sizes), strict=True)]


@solvers
@supports
@pytest.mark.parametrize("EA", [10.0, 1e3, 1e6], ids="EA {:g} N".format)
def test_a_hanging_elastic_chain_tends_to_the_elastic_catenary_with_order_two(solver, support, EA):
    """From an extension of a half of the cable's length to one of 1e-5 of it."""
    counts = [17, 33, 65, 129]
    errors = [
        np.abs(equilibrium(n, EA, support, solver) - solve_hanging_shape(cable(n, EA), support)).max() for n in counts
    ]
    assert errors[-1] <= 1e-3 * LENGTH
    # The next term of the midpoint rule is smaller by a link's share of the bow's radius, squared: at most 1/10.
    np.testing.assert_allclose(orders([1.0 / (n - 1) for n in counts], errors), 2.0, rtol=0, atol=0.1)


@solvers
@supports
def test_a_stiffer_and_stiffer_chain_tends_to_inextensible_links_with_order_one(solver, support):
    """Links stretch by T / EA: 1e-2 to 1e-8 of their length."""
    stiffness = [WEIGHT * 10.0**k for k in range(2, 9)]
    expected = solve_hanging_shape(links(13), support)
    errors = [np.abs(equilibrium(13, EA, support, solver) - expected).max() for EA in stiffness]
    # The next term is smaller by the strain, 1e-2 to begin with; round-off of the last, 1e-8, is 1e-15 of the length
    # over the stiffness of the bow next to that of the links.
    np.testing.assert_allclose(orders([1.0 / EA for EA in stiffness], errors), 1.0, rtol=0, atol=0.02)


@supports
def test_inextensible_links_tend_to_the_catenary_with_order_two(support):
    counts = [17, 33, 65, 129]
    errors = [
        np.abs(solve_hanging_shape(links(n), support) - solve_hanging_shape(cable(n, np.inf), support)).max()
        for n in counts
    ]
    np.testing.assert_allclose(orders([1.0 / (n - 1) for n in counts], errors), 2.0, rtol=0, atol=0.1)  # as above


@solvers
@supports
def test_a_chain_that_hardly_stretches_hangs_as_the_inextensible_catenary(solver, support):
    found = equilibrium(65, 1e8 * WEIGHT, support, solver)
    # Of 64 links each is short of its arc by a part of (w r / H)^2 / 24, 1e-4 to 1e-5; the strain is 1e-8.
    np.testing.assert_allclose(found, solve_hanging_shape(cable(65, np.inf), support), rtol=0, atol=2e-4 * LENGTH)
