"""The supernodal factorisation: its solutions, its refusals, its exact counts."""

from __future__ import annotations

import re

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import block_diag, csr_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from springbench.solvers.linalg.cholesky import supernodal_cholesky
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.model.step_problem import NotPositiveDefinite
from springbench.solvers.model.system_matrix_assembly import diagonal_matrix, drop_zeros, signed_incidence_matrix_sparse


def network(springs, stiffness, fixed):
    """A'KA + diag(anchors) [N/m]."""
    A = signed_incidence_matrix_sparse(np.asarray(springs, np.int64).reshape(-1, 2), len(fixed))
    return drop_zeros(
        A.T @ diagonal_matrix(np.asarray(stiffness, float)) @ A + diagonal_matrix(np.asarray(fixed, float))
    )


def sheet(n, stiffness=1e5):
    """A grid of n x n vertices of mass 1/n^2 at dt = 1/30, sides and both diagonals, two corners pinned by 1e10."""
    index = np.arange(n * n).reshape(n, n)
    ends = [
        (index[:, :-1], index[:, 1:]),
        (index[:-1], index[1:]),
        (index[:-1, :-1], index[1:, 1:]),
        (index[1:, :-1], index[:-1, 1:]),
    ]
    springs = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in ends])
    diagonal = np.full(n * n, 900.0 / n**2)
    diagonal[[0, n - 1]] += 1e10
    return network(springs, np.full(len(springs), stiffness), diagonal)


def solution(Q, b, **options):
    out = np.full_like(b, np.nan)
    SupernodalCholesky(Q, **options).solve(b, out)
    return out


def vertices(Q):
    return len(Q.indptr) - 1


def right_hand_sides(n, seed=0):
    return np.random.default_rng(seed).normal(size=(n, 3))


def backward_error(Q, x, b):
    """The least relative change of each entry of Q and b that x solves exactly (Oettli and Prager 1964).

    Between stiffnesses that lie decades apart a norm would see the stiff vertices alone; this sees each by itself.
    """
    return np.max(np.abs(b - Q @ x) / (abs(Q) @ np.abs(x) + np.abs(b)))


@st.composite
def networks(draw, decades=2.0):
    """A random network of several components, isolated vertices and doubled springs included."""
    n = draw(st.integers(1, 300))
    m = draw(st.integers(0, 4 * n))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    ends = rng.integers(0, n, (m, 2))
    near = (ends[:, 0] + rng.integers(0, 12, m)) % n  # half of the springs are short, as in a mesh
    ends[: m // 2, 1] = near[: m // 2]
    return network(ends, 10.0 ** rng.uniform(0, decades, m), 10.0 ** rng.uniform(0, decades, n))


@settings(max_examples=60, deadline=None)
@given(networks())
def test_solves_random_networks_as_superlu_does(Q):
    b = right_hand_sides(vertices(Q))
    expected = splu(Q.tocsc()).solve(b)
    # Entries of Q span 4 decades at most, so that its condition times the round-off stays below this.
    assert np.abs(solution(Q, b) - expected).max() <= 1e-12 * np.abs(expected).max()


@settings(max_examples=60, deadline=None)
@given(networks(decades=12.0))
def test_is_backward_stable_over_twelve_decades_of_stiffness(Q):
    b = right_hand_sides(vertices(Q))
    # The solutions themselves have no digits in common with anything at a condition of 1e16 and more; the equations
    # must hold to round-off all the same. n eps is 7e-14 at 300 vertices.
    assert backward_error(Q, solution(Q, b), b) <= 1e-12


@settings(max_examples=30, deadline=None)
@given(networks())
def test_a_float32_factor_is_accurate_to_float32(Q):
    b = right_hand_sides(vertices(Q))
    expected = splu(Q.tocsc()).solve(b)
    # 6e-8 times a condition of up to 1e3 of these networks
    assert np.abs(solution(Q, b, precision="float32") - expected).max() <= 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize(("precision", "corrections"), [("float32", 4), ("float16", 6)])
def test_a_rounded_factor_in_correction_form_reaches_the_solution_of_float64(precision, corrections):
    Q = sheet(40)
    b = right_hand_sides(1600)
    factor = SupernodalCholesky(Q, precision=precision)
    x, step = np.zeros_like(b), np.empty_like(b)
    for _ in range(corrections):
        factor.solve(b - Q @ x, step)
        x += step
    expected = solution(Q, b)
    # Without the rows of its pins Q has a condition of 1e4: what float64 itself leaves, with a margin.
    assert np.abs(x - expected).max() <= 1e-11 * np.abs(expected).max()


def test_a_correction_by_a_half_precision_factor_overshoots_by_next_to_nothing():
    """Descent needs eigenvalues below 2 of what the factor makes of Q. Rounded entry by entry they grow with n."""
    Q, v = sheet(64), right_hand_sides(4096)
    factor, out = SupernodalCholesky(Q, precision="float16"), np.empty((4096, 3))
    growth = 0.0
    for _ in range(40):
        factor.solve(Q @ v, out)
        growth = np.linalg.norm(out) / np.linalg.norm(v)
        v = out / np.linalg.norm(out)
    # 1.0001 measured here and 1.0002 at 256 x 256; 1.007 where the sums of columns are not preserved
    assert growth <= 1.001


@pytest.mark.parametrize("precision", ["float64", "float32", "float16"])
def test_what_a_factor_applies_is_symmetric_and_positive_definite(precision):
    Q = sheet(12)
    factor = SupernodalCholesky(Q, precision=precision)
    inverse = np.empty((144, 144))
    for k in range(0, 144, 3):
        out = np.empty((144, 3))
        factor.solve(np.eye(144)[:, k : k + 3], out)
        inverse[:, k : k + 3] = out
    scale = np.sqrt(np.outer(np.diag(inverse), np.diag(inverse)))
    # Sums of a few hundred terms in the precision of the work vector.
    tolerance = 1e-13 if precision == "float64" else 1e-5
    assert np.max(np.abs(inverse - inverse.T) / scale) <= tolerance
    assert np.linalg.eigvalsh((inverse + inverse.T) / 2 / scale).min() > 0.0


CASES = {
    "one vertex": network([], [], [2.0]),
    "isolated vertices": network([], [], np.arange(1.0, 400.0)),
    "a star": network([(0, i) for i in range(1, 600)], np.ones(599), np.ones(600)),
    "a chain": network([(i, i + 1) for i in range(999)], np.ones(999), np.full(1000, 0.01)),
    "a sheet": sheet(33),
    "two sheets and a vertex": csr_array(np.kron(np.eye(2), sheet(11).toarray())),
    "dense": csr_array(np.full((200, 200), -1.0) + 201.0 * np.eye(200)),
    "a large dense block": csr_array(np.full((700, 700), -1.0) + 701.0 * np.eye(700)),
    "not of springs": csr_array(np.cov(np.random.default_rng(1).normal(size=(60, 200)))),
}


@pytest.mark.parametrize("name", CASES)
def test_solves_networks_of_every_shape(name):
    Q = CASES[name]
    b = right_hand_sides(vertices(Q))
    expected = splu(Q.tocsc()).solve(b)
    # The sheet has a condition of 1e10 in its norm, of 1e4 without the rows of its pins: 1e4 eps and a margin.
    assert np.abs(solution(Q, b) - expected).max() <= 1e-11 * np.abs(expected).max()
    assert backward_error(Q, solution(Q, b), b) <= 1e-12


def test_solves_no_equations_at_all():
    assert solution(csr_array((0, 0)), np.empty((0, 3))).shape == (0, 3)


def test_columns_in_any_order_and_entries_in_parts_mean_the_same_matrix():
    Q = sheet(12)
    rows = Q.tocoo().row
    shuffled = np.lexsort((np.random.default_rng(0).random(Q.nnz), rows))
    parts = csr_array((np.repeat(Q.data[shuffled] / 2, 2), np.repeat(Q.indices[shuffled], 2), 2 * Q.indptr), Q.shape)
    b = right_hand_sides(144)
    # Halves add up exactly; their places in a row change nothing but the order that vertices are eliminated in.
    assert np.abs(solution(parts, b) - solution(Q, b)).max() <= 1e-11 * np.abs(solution(Q, b)).max()


def test_leaves_the_right_hand_sides_as_they_are():
    b = right_hand_sides(400)
    original = b.copy()
    solution(sheet(20), b)
    np.testing.assert_array_equal(b, original)


@pytest.mark.parametrize("precision", ["float64", "float32", "float16"])
def test_gives_the_same_bits_each_time(precision):
    Q, b = sheet(40), right_hand_sides(1600)
    first, second = SupernodalCholesky(Q, precision=precision), SupernodalCholesky(Q, precision=precision)
    results = [np.empty_like(b) for _ in range(4)]
    for k, out in enumerate(results):
        (first, second)[k % 2].solve(b, out)
    for out in results[1:]:
        np.testing.assert_array_equal(out, results[0])


@pytest.fixture
def threads():
    """Numba's setting of threads, put back afterwards."""
    before = numba.get_num_threads()
    yield numba.set_num_threads
    numba.set_num_threads(before)


@pytest.mark.parametrize("precision", ["float64", "float32", "float16"])
def test_gives_the_same_bits_whatever_the_number_of_threads(precision, threads, monkeypatch):
    monkeypatch.setattr(supernodal_cholesky, "_MIN_THREADED_BYTES", 0)
    Q, b = sheet(64), right_hand_sides(4096)
    factor = SupernodalCholesky(Q, precision=precision)
    results = []
    for count in range(1, numba.get_num_threads() + 1):
        threads(count)
        results.append(np.empty_like(b))
        factor.solve(b, results[-1])
    assert len(factor.work_shares) > 1  # large enough to be shared out
    for out in results[1:]:
        np.testing.assert_array_equal(out, results[0])


def test_shares_work_out_evenly_with_little_at_the_top():
    shares = SupernodalCholesky(sheet(64)).work_shares
    assert len(shares) == 5
    assert max(shares[:-1]) <= 1.1 / 4 + 1e-9
    assert shares[-1] <= 0.06  # the separators of two levels of dissection, of eight
    assert len(SupernodalCholesky(sheet(16)).work_shares) == 2
    assert SupernodalCholesky(sheet(16)).work_shares[-1] == 0.0


def test_separate_components_are_shared_out_too():
    parts = block_diag([sheet(30)] * 8, format="csr")
    b = right_hand_sides(vertices(parts))
    factor = SupernodalCholesky(csr_array(parts))
    assert max(factor.work_shares) <= 0.26
    out = np.empty_like(b)
    factor.solve(b, out)
    assert backward_error(parts, out, b) <= 1e-12


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_refuses_a_matrix_that_is_not_finite_and_states_where(value):
    Q = sheet(5)
    Q.data[Q.indptr[7]] = value
    with pytest.raises(NotPositiveDefinite, match=r"not finite in row 7\b"):
        SupernodalCholesky(Q)


def test_names_the_vertex_that_a_negative_mass_makes_indefinite():
    Q = csr_array(diagonal_matrix(np.where(np.arange(50) == 31, -1.0, 1.0)))
    with pytest.raises(NotPositiveDefinite, match=r"vertex 31\b"):
        SupernodalCholesky(Q)


def test_names_a_vertex_of_the_unconstrained_component():
    springs = [(i, i + 1) for i in range(199) if i != 99]
    diagonal = np.where(np.arange(200) < 100, 1.0, 0.0)
    Q = network(springs, np.random.default_rng(3).uniform(1, 2, 198), diagonal)
    with pytest.raises(NotPositiveDefinite, match=r"vertex \d+") as error:
        SupernodalCholesky(Q)
    named = int(re.findall(r"vertex (\d+)", str(error.value))[0])
    assert connected_components(Q)[1][named] == connected_components(Q)[1][150]


def test_refuses_a_row_without_entries():
    Q = csr_array(eye_array(6, format="csr"))
    Q.data[4] = 0.0
    Q.eliminate_zeros()
    with pytest.raises(NotPositiveDefinite, match=r"vertex 4\b"):
        SupernodalCholesky(Q)


def test_counts_bytes_and_flops_of_a_matrix_known_by_hand():
    # A dense 20 x 20: chunks of 16 and 4 columns. Panels: 20 rows of 16 and 4 rows of 4 entries.
    # Backwards all of them, forwards the rows below the chunk (4 of 16); 2 flops an entry and right-hand side.
    Q = csr_array(np.full((20, 20), -1.0) + 21.0 * np.eye(20))
    factor = SupernodalCholesky(Q)
    assert factor.nonzeros == 20 * 21 // 2
    assert factor.factor_bytes == (20 * 16 + 4 * 4) * 8
    assert factor.flops == 2 * 3 * (20 * 16 + 4 * 4 + 4 * 16)
    assert factor.work_shares == [1.0, 0.0]
    assert SupernodalCholesky(Q, precision="float32").factor_bytes == factor.factor_bytes // 2
    # The inverses of the chunks, 16 x 16 and 4 x 4, stay in float32.
    assert SupernodalCholesky(Q, precision="float16").factor_bytes == (16 * 16 + 4 * 4) * 4 + 4 * 16 * 2
