"""The springs' energy: its derivatives, the bound that makes the method descend, and springs of zero length."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from springbench.solvers.model.energies.spring_energy import ZERO_LENGTH, Springs

from tests.scene_builders import build_random_network

seeds = st.integers(0, 2**32 - 1)

STEP = 1e-6
"""Of central differences: they are wrong by about STEP^2 and by round-off / STEP, 1e-10 of the terms both."""
DIFFERENCE = 1e-6
"""Their tolerance: shortest springs are about 0.1 long, which multiplies the error by up to 1e3."""
ROUND_OFF = 1e-12
"""A few hundred additions."""

X = np.array([1.0, 0.0, 0.0])


def network(seed, n=8, m=20):
    """Springs of a random rest shape, and other random positions."""
    rng = np.random.default_rng(seed)
    _, springs = build_random_network(rng, n, m)
    return rng, springs, rng.normal(size=(n, 3))


def shortest(springs, p):
    i, j = springs.edges[springs.edges[:, 0] != springs.edges[:, 1]].T
    return np.linalg.norm(p[i] - p[j], axis=1).min()


def gradient(springs, p):
    out = np.zeros_like(p)
    springs.add_gradient(p, out)
    return out


def projection(springs, p):
    out = np.zeros_like(p)
    springs.add_projection(p, out)
    return out


def single(rest_length, length, direction=X):
    """One spring of 10 N/m along `direction` in the rest shape, and positions at a distance along x."""
    springs = Springs(np.array([[0, 1]]), np.array([10.0]), np.array([rest_length]), np.array([direction]))
    return springs, np.array([length * X, 0 * X])


@given(seeds)
def test_the_gradient_is_the_derivative_of_the_energy(seed):
    rng, springs, p = network(seed)
    assume(shortest(springs, p) > 0.1)  # nearer to zero length, which has tests of its own, differences fail
    v = rng.normal(size=p.shape)
    slope = (springs.value(p + STEP * v) - springs.value(p - STEP * v)) / (2 * STEP)
    scale = np.abs(gradient(springs, p) * v).sum() + springs.value(p)
    assert abs(np.sum(gradient(springs, p) * v) - slope) <= DIFFERENCE * scale


@given(seeds)
def test_the_hessian_is_the_derivative_of_the_gradient(seed):
    rng, springs, p = network(seed)
    assume(shortest(springs, p) > 0.1)
    v = rng.normal(size=p.shape)
    slope = (gradient(springs, p + STEP * v) - gradient(springs, p - STEP * v)) / (2 * STEP)
    H = springs.hessian(p).toarray()
    np.testing.assert_allclose((H @ v.ravel()).reshape(-1, 3), slope, rtol=0, atol=DIFFERENCE * np.abs(H).max())


@given(seeds)
def test_the_hessian_is_symmetric_and_stores_no_zeros(seed):
    _, springs, p = network(seed)
    H = springs.hessian(p)
    assert np.abs((H - H.T).toarray()).max() <= ROUND_OFF * np.abs(H.data).max(initial=0.0)
    assert np.count_nonzero(H.data) == H.nnz
    assert H.shape == (p.size, p.size)


@given(seeds, st.sampled_from([1.0, 1e-3, 0.0]))
def test_the_stiffness_bounds_the_hessian(seed, squeeze):
    """Squeezed springs push back sideways: there the Hessian is indefinite and the bound matters most."""
    _, springs, p = network(seed)
    p = squeeze * p
    H = springs.hessian(p).toarray()
    bound = np.kron(springs.stiffness_matrix(len(p)).toarray(), np.eye(3))
    assert np.linalg.eigvalsh(bound - H).min() >= -ROUND_OFF * np.abs(H).max()


@given(seeds)
def test_the_gradient_is_the_stiffness_times_the_positions_less_the_projection(seed):
    _, springs, p = network(seed)
    expected = springs.stiffness_matrix(len(p)) @ p - projection(springs, p)
    np.testing.assert_allclose(gradient(springs, p), expected, rtol=0, atol=ROUND_OFF * np.abs(expected).max())


@given(seeds)
def test_the_energy_is_the_least_over_all_directions(seed):
    """min over |d_e| = r_e of k/2 |v_e - d_e|^2 is k/2 (|v_e| - r_e)^2: what makes it projective."""
    rng, springs, p = network(seed)
    i, j = springs.edges.T
    v = p[i] - p[j]

    def stored_energy(unit):
        return 0.5 * springs.stiffness @ np.sum((v - springs.rest_length[:, None] * unit) ** 2, axis=1)

    length = np.linalg.norm(v, axis=1)
    best = v / np.where(length, length, 1.0)[:, None]
    assert stored_energy(best) == pytest.approx(springs.value(p), rel=ROUND_OFF)
    other = rng.normal(size=v.shape)
    assert stored_energy(other / np.linalg.norm(other, axis=1)[:, None]) >= springs.value(p)


@given(seeds)
def test_springs_alone_exert_no_force_and_no_torque(seed):
    _, springs, p = network(seed)
    pull = gradient(springs, p)
    np.testing.assert_allclose(pull.sum(axis=0), 0.0, atol=ROUND_OFF * np.abs(pull).max())
    np.testing.assert_allclose(np.cross(p, pull).sum(axis=0), 0.0, atol=ROUND_OFF * np.abs(pull).max())


def test_a_spring_at_rest_is_at_rest():
    rest, springs = build_random_network(np.random.default_rng(0), 8, 20)
    assert np.abs(gradient(springs, rest)).max() <= ROUND_OFF * springs.stiffness.max()
    assert springs.value(rest) <= ROUND_OFF**2 * springs.stiffness.sum()  # its square root is a length


def test_rest_lengths_that_differ_by_round_off_alone_are_equal():
    x = np.linspace(0.0, 1.0, 1000)  # differences of neighbours have several last bits
    edges = np.stack([np.arange(999), np.arange(1, 1000)], axis=1)
    even = np.stack([x, 0 * x, 0 * x], axis=1)
    assert len(np.unique(Springs.from_rest_shape(even, edges, np.ones(999)).rest_length)) == 1
    other = even.copy()
    other[-1, 0] += 1e-14
    assert len(np.unique(Springs.from_rest_shape(other, edges, np.ones(999)).rest_length)) == 2


def test_value_and_gradient_of_one_stretched_spring():
    springs, p = single(rest_length=1.0, length=1.5)
    assert springs.value(p) == 0.5 * 10 * 0.5**2
    np.testing.assert_array_equal(gradient(springs, p), [10 * 0.5 * X, -10 * 0.5 * X])


def test_each_spring_has_its_own_stiffness():
    rest = np.array([0 * X, X, 2 * X])
    springs = Springs.from_rest_shape(rest, np.array([[0, 1], [1, 2]]), np.array([1.0, 100.0]))
    assert springs.value(2 * rest) == 0.5 * 1 + 0.5 * 100


def test_gradients_and_projections_are_added_to_the_output():
    springs, p = single(rest_length=1.0, length=1.5)
    for add in (springs.add_gradient, springs.add_projection):
        out = np.full((4, 3), 7.0)
        add(np.vstack([p, p]), out)
        assert (out[2:] == 7.0).all()
        np.testing.assert_array_equal(out[:2].sum(axis=0), 14.0)  # equal and opposite on top of 7


ZERO_LENGTHS = [0.0, 1e-170, ZERO_LENGTH, -ZERO_LENGTH]


@pytest.mark.parametrize("length", ZERO_LENGTHS)
def test_a_spring_of_zero_length_takes_the_direction_of_its_rest_shape(length):
    direction = np.array([0.0, 0.6, -0.8])
    springs, p = single(rest_length=2.0, length=length, direction=direction)
    pull = 10 * 2 * direction
    np.testing.assert_allclose(gradient(springs, p), [-pull, pull], rtol=0, atol=ROUND_OFF)
    np.testing.assert_allclose(projection(springs, p), [pull, -pull], rtol=0, atol=ROUND_OFF)


def test_a_spring_that_had_no_length_at_rest_takes_a_fixed_direction():
    rest = np.zeros((2, 3))
    springs = Springs.from_rest_shape(rest, np.array([[0, 1]]), np.ones(1))
    np.testing.assert_array_equal(springs.rest_direction, [X])
    assert springs.value(rest) == 0.0
    np.testing.assert_array_equal(gradient(springs, rest), np.zeros((2, 3)))


@pytest.mark.parametrize("length", [0.0, 1e-170, 1e-3, 5.0])
def test_a_spring_of_no_rest_length_is_quadratic_everywhere(length):
    springs, p = single(rest_length=0.0, length=length)
    assert springs.value(p) == pytest.approx(5 * length**2)
    np.testing.assert_allclose(gradient(springs, p), [10 * length * X, -10 * length * X])
    expected = np.kron([[10.0, -10.0], [-10.0, 10.0]], np.eye(3))
    np.testing.assert_allclose(springs.hessian(p).toarray(), expected, rtol=ROUND_OFF)


def test_a_spring_of_zero_length_has_curvature_along_its_direction_alone():
    springs, p = single(rest_length=1.0, length=0.0)
    expected = np.kron([[10.0, -10.0], [-10.0, 10.0]], np.outer(X, X))
    np.testing.assert_array_equal(springs.hessian(p).toarray(), expected)


def test_a_loop_stores_nothing_and_pulls_nowhere():
    p = np.random.default_rng(0).normal(size=(2, 3))
    springs = Springs.from_rest_shape(p, np.array([[1, 1]]), np.ones(1))
    assert springs.value(2 * p) == 0.0
    assert not gradient(springs, 2 * p).any()
    assert not projection(springs, 2 * p).any()
    assert springs.hessian(2 * p).nnz == springs.stiffness_matrix(2).nnz == 0


def test_no_springs_are_an_energy_of_zero():
    none, p = Springs.from_parts([]), np.ones((3, 3))
    assert none.value(p) == 0.0
    assert not gradient(none, p).any()
    assert not projection(none, p).any()
    assert none.hessian(p).nnz == none.stiffness_matrix(3).nnz == 0


@given(seeds, st.integers(-200, 12))
def test_nothing_is_ever_nan(seed, exponent):
    _, springs, p = network(seed)
    p = 10.0**exponent * p
    numbers = [springs.value(p), gradient(springs, p), projection(springs, p), springs.hessian(p).data]
    assert all(np.isfinite(x).all() for x in numbers)


@given(seeds)
def test_joined_springs_are_the_sum_of_their_parts(seed):
    rng, one, p = network(seed)
    _, other = build_random_network(rng, len(p), 5)
    joined = Springs.from_parts([one, other])
    assert joined.value(p) == pytest.approx(one.value(p) + other.value(p), rel=ROUND_OFF)
    both = gradient(one, p) + gradient(other, p)
    np.testing.assert_allclose(gradient(joined, p), both, rtol=0, atol=ROUND_OFF * np.abs(both).max())
    assert Springs.from_parts([one]) is one
