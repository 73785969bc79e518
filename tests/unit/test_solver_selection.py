"""The choice of a linear solver: by size and by exact counts, forced on request, refused with the numbers."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.memory import compute_memory_limit
from springbench.solvers.linalg.solver_selection import MAX_DENSE_VERTICES, build_linear_solver, select_solver
from springbench.solvers.model.step_problem import NotPositiveDefinite, Unsupported

from tests.network_matrices import backward_error, grid_matrix, grid_springs, network_matrix, random_right_hand_sides

PLENTY = 1e12
LINEAR_SOLVERS = ["inverse", "cholespy", "supernodal", "cg"]


def build_random_network():
    """Six thousand vertices with springs at random: no few of them separate the others."""
    ends = np.random.default_rng(0).integers(0, 6000, (36000, 2))
    return network_matrix(ends, 1.0, np.full(6000, 0.1))


def read_needed_bytes(Q, name, memory=0.0):
    """The bytes that a refusal names."""
    with pytest.raises(Unsupported, match="does not fit in") as error:
        select_solver(Q, name, memory_limit=memory)
    number, unit = re.findall(rf"{name} needs ([\d.,e+]+) (\w+)", str(error.value))[0]
    return float(number.replace(",", "")) * 1024.0 ** ["bytes", "KiB", "MiB", "GiB"].index(unit)


@pytest.mark.parametrize("side", [2, 11, 12, 60])
def test_small_systems_get_an_inverse_and_larger_ones_a_factor(side):
    name = "inverse" if side**2 <= MAX_DENSE_VERTICES else "supernodal"
    choice = select_solver(grid_matrix(side, side), memory_limit=PLENTY)
    assert choice.solver_name == name
    count = choice.symbolic_factor.nonzeros if choice.symbolic_factor else side**2
    assert f"{count:,}" in choice.reason


@pytest.mark.parametrize("precision", ["float64", "float32", "float16"])
def test_a_solid_gets_a_factor_in_every_precision(precision):
    factor, why = build_linear_solver(grid_matrix(8, 8, 8), precision=precision, memory_limit=PLENTY)
    assert isinstance(factor, SupernodalCholesky)
    assert precision in why


def test_a_graph_that_nothing_separates_gets_conjugate_gradients():
    choice = select_solver(build_random_network(), memory_limit=PLENTY)
    assert choice.solver_name == "cg"
    assert "a factor would cost more" in choice.reason


def test_conjugate_gradients_replace_a_factor_that_does_not_fit():
    Q = grid_matrix(15, 15, 15)
    direct, iterative = read_needed_bytes(Q, "supernodal"), read_needed_bytes(Q, "cg")
    assert iterative < direct
    assert select_solver(Q, memory_limit=1.01 * direct).solver_name == "supernodal"
    choice = select_solver(Q, memory_limit=0.5 * (direct + iterative))
    assert choice.solver_name == "cg"
    assert "would not fit" in choice.reason


def test_what_fits_nowhere_is_refused_with_the_bytes_of_each_and_the_limit():
    Q = grid_matrix(15, 15, 15)
    with pytest.raises(Unsupported, match=r"does not fit in 1 MiB.*supernodal needs .* MiB.*cg needs .* MiB") as error:
        select_solver(Q, memory_limit=2.0**20)
    symbolic = select_solver(Q, "supernodal", memory_limit=PLENTY).symbolic_factor
    assert symbolic
    assert f"{symbolic.nonzeros:,} entries" in str(error.value)
    assert f"{Q.nnz:,} entries" in str(error.value)


@pytest.mark.parametrize("name", ["inverse", "supernodal", "cg"])
def test_a_solver_that_is_forced_is_refused_too_where_it_does_not_fit(name):
    Q = grid_matrix(15, 15, 15)
    assert select_solver(Q, name, memory_limit=1.01 * read_needed_bytes(Q, name)).solver_name == name
    assert read_needed_bytes(Q, name, memory=0.9 * read_needed_bytes(Q, name)) > 0


def test_the_estimate_of_a_factor_covers_its_panels():
    for shape in ((60, 60), (15, 15, 15)):
        Q = grid_matrix(*shape)
        # The panels, and in addition no more than those of L, as large again, and updates.
        assert (
            SupernodalCholesky(Q).factor_bytes
            < read_needed_bytes(Q, "supernodal")
            < 3 * SupernodalCholesky(Q).factor_bytes
        )


def test_the_limit_of_the_machine_is_below_its_memory():
    assert 2**28 < compute_memory_limit() < 2**46


@pytest.mark.parametrize("linear", ["auto", *LINEAR_SOLVERS])
@pytest.mark.parametrize("shape", [(10, 10), (33, 33), (9, 9, 9)], ids=str)
def test_every_choice_solves_the_same_system(shape, linear):
    Q = grid_matrix(*shape)
    b = random_right_hand_sides(int(np.prod(shape)))
    factor, why = build_linear_solver(Q, linear, memory_limit=PLENTY)
    assert linear in (why.partition(":")[0], "auto")
    out, expected = np.empty_like(b), np.empty_like(b)
    factor.solve(b, out)
    SupernodalCholesky(Q).solve(b, expected)
    # cg ends within 1e-12 of the largest; direct solvers differ by the condition, 1e4 without the pins, times eps
    assert np.abs(out - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("precision", ["float32", "float16"])
@pytest.mark.parametrize("linear", ["auto", "inverse", "supernodal", "cg"])
@pytest.mark.parametrize("shape", [(10, 10), (33, 33)], ids=str)
def test_every_precision_reaches_the_solution_of_float64_by_corrections(shape, linear, precision):
    Q = grid_matrix(*shape)
    b = random_right_hand_sides(int(np.prod(shape)))
    expected, x, step = np.empty_like(b), np.zeros_like(b), np.empty_like(b)
    SupernodalCholesky(Q).solve(b, expected)
    factor, _ = build_linear_solver(Q, linear, precision, memory_limit=PLENTY)
    for _ in range(30):  # float16 gains two digits at first and a factor of two at least in the worst direction
        factor.solve(b - Q @ x, step)
        x += step
    # The residual is rounded to eps times the condition, 1e4 without the rows of the pins.
    assert np.abs(x - expected).max() <= 1e-10 * np.abs(expected).max()


def test_the_choice_follows_from_the_graph_alone():
    springs = grid_springs(40, 40)
    weak, strong = (network_matrix(springs, k, np.ones(1600)) for k in (1e-3, 1e9))
    assert select_solver(weak, memory_limit=PLENTY).reason == select_solver(strong, memory_limit=PLENTY).reason


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(Unsupported, match=r"'lu' is unknown; expected one of auto, inverse, cholespy, supernodal, cg"):
        build_linear_solver(grid_matrix(3, 3), "lu")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_cholespy_is_refused_in_less_than_float64(precision):
    with pytest.raises(Unsupported, match="supports float64 only, not float"):
        build_linear_solver(grid_matrix(3, 3), "cholespy", precision)


@pytest.mark.parametrize("linear", ["auto", "inverse", "supernodal", "cg"])
@pytest.mark.parametrize("side", [10, 20])
def test_no_choice_takes_a_matrix_that_is_not_positive_definite(side, linear):
    Q = grid_matrix(side, side)
    Q.data[Q.indptr[5] + np.searchsorted(Q.indices[Q.indptr[5] : Q.indptr[6]], 5)] = -1.0
    with pytest.raises(NotPositiveDefinite, match=r"vertex \d"):
        build_linear_solver(Q, linear)


@pytest.mark.parametrize("linear", ["auto", *LINEAR_SOLVERS])
@pytest.mark.parametrize("side", [10, 20])
def test_no_choice_takes_a_matrix_that_is_not_finite(side, linear):
    Q = grid_matrix(side, side)
    Q.data[Q.indptr[7]] = np.nan
    with pytest.raises(NotPositiveDefinite):
        build_linear_solver(Q, linear)


def test_an_inverse_is_exact_over_twelve_decades_of_stiffness():
    springs, rng = grid_springs(11, 11), np.random.default_rng(2)
    Q = network_matrix(springs, 10.0 ** rng.uniform(0, 12, len(springs)), 10.0 ** rng.uniform(0, 12, 121))
    b, out = random_right_hand_sides(121), np.empty((121, 3))
    build_linear_solver(Q, "inverse")[0].solve(b, out)
    # An inverse solves each equation to its condition times eps: those of 121 vertices to some hundred.
    assert backward_error(Q, out, b) <= 1e-11


def test_an_inverse_solves_no_equations_at_all():
    out = np.empty((0, 3))
    build_linear_solver(csr_array((0, 0)), "inverse")[0].solve(np.empty((0, 3)), out)
    assert out.shape == (0, 3)


@pytest.mark.parametrize("n", range(1, 10))
def test_an_inverse_of_every_small_size_is_right(n):
    Q = network_matrix([(i, i + 1) for i in range(n - 1)], 2.0, np.ones(n))
    b, out = random_right_hand_sides(n), np.empty((n, 3))
    factor = build_linear_solver(Q, "inverse")[0]
    factor.solve(b, out)
    # a condition of 9 at most
    np.testing.assert_allclose(Q @ out, b, rtol=0, atol=1e-14)
    assert factor.nonzeros == n * (n + 1) // 2


def test_stiffnesses_too_far_apart_for_a_precision_are_solved_in_float64():
    ends = np.array([[0, 1], [1, 2], [2, 3]])
    Q = network_matrix(ends, np.array([1e14, 100.0, 1e14]), np.full(4, 0.1))
    factor, why = build_linear_solver(Q, "supernodal", "float32", memory_limit=PLENTY)
    assert "in float64, for stiffnesses lie too far apart for float32" in why
    assert isinstance(factor, SupernodalCholesky)
    assert factor.inverse_blocks.dtype == np.float64
    assert "too far apart" not in build_linear_solver(grid_matrix(10, 10), precision="float16", memory_limit=PLENTY)[1]
