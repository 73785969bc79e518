"""The choice of a linear solver: by size and by exact counts, forced where asked, refused with the numbers."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.sparse import csr_array

from solvers.linear.choice import SMALL, choose, factorise
from solvers.linear.supernodal import Supernodal
from solvers.memory import of_machine
from solvers.problem import NotPositiveDefinite, Unsupported
from tests.networks import backward_error, grid, grid_springs, network, right_hand_sides

PLENTY = 1e12
FORCED = ["inverse", "cholespy", "supernodal", "cg"]


def entangled():
    """Six thousand vertices with springs at random: no few of them separate the others."""
    ends = np.random.default_rng(0).integers(0, 6000, (36000, 2))
    return network(ends, 1.0, np.full(6000, 0.1))


def needed(Q, name, memory=0.0):
    """The bytes that a refusal names."""
    with pytest.raises(Unsupported, match="does not fit in") as error:
        choose(Q, name, memory=memory)
    number, unit = re.findall(rf"{name} needs ([\d.,e+]+) (\w+)", str(error.value))[0]
    return float(number.replace(",", "")) * 1024.0 ** ["bytes", "KiB", "MiB", "GiB"].index(unit)


@pytest.mark.parametrize("side", [2, 11, 12, 60])
def test_small_systems_get_an_inverse_and_larger_ones_a_factor(side):
    name = "inverse" if side**2 <= SMALL else "supernodal"
    choice = choose(grid(side, side), memory=PLENTY)
    assert choice.name == name
    count = choice.symbolic.nonzeros if choice.symbolic else side**2
    assert f"{count:,}" in choice.why


@pytest.mark.parametrize("precision", ["float64", "float32", "float16"])
def test_a_solid_gets_a_factor_in_every_precision(precision):
    factor, why = factorise(grid(8, 8, 8), precision=precision, memory=PLENTY)
    assert isinstance(factor, Supernodal)
    assert precision in why


def test_a_graph_that_nothing_separates_gets_conjugate_gradients():
    choice = choose(entangled(), memory=PLENTY)
    assert choice.name == "cg"
    assert "a factor would cost more" in choice.why


def test_a_factor_that_does_not_fit_gives_way_to_conjugate_gradients():
    Q = grid(15, 15, 15)
    direct, iterative = needed(Q, "supernodal"), needed(Q, "cg")
    assert iterative < direct
    assert choose(Q, memory=1.01 * direct).name == "supernodal"
    choice = choose(Q, memory=0.5 * (direct + iterative))
    assert choice.name == "cg"
    assert "would not fit" in choice.why


def test_what_fits_nowhere_is_refused_with_the_bytes_of_each_and_the_limit():
    Q = grid(15, 15, 15)
    with pytest.raises(Unsupported, match=r"does not fit in 1 MiB.*supernodal needs .* MiB.*cg needs .* MiB") as error:
        choose(Q, memory=2.0**20)
    symbolic = choose(Q, "supernodal", memory=PLENTY).symbolic
    assert symbolic
    assert f"{symbolic.nonzeros:,} entries" in str(error.value)
    assert f"{Q.nnz:,} entries" in str(error.value)


@pytest.mark.parametrize("name", ["inverse", "supernodal", "cg"])
def test_a_solver_that_is_forced_is_refused_too_where_it_does_not_fit(name):
    Q = grid(15, 15, 15)
    assert choose(Q, name, memory=1.01 * needed(Q, name)).name == name
    assert needed(Q, name, memory=0.9 * needed(Q, name)) > 0


def test_the_estimate_of_a_factor_covers_its_panels():
    for shape in ((60, 60), (15, 15, 15)):
        Q = grid(*shape)
        # The panels, and beside them no more than fronts and updates: in such small solids they are as large again.
        assert Supernodal(Q).panel_bytes < needed(Q, "supernodal") < 2.5 * Supernodal(Q).panel_bytes


def test_the_limit_of_the_machine_is_below_its_memory():
    assert 2**28 < of_machine() < 2**46


@pytest.mark.parametrize("linear", ["auto", *FORCED])
@pytest.mark.parametrize("shape", [(10, 10), (33, 33), (9, 9, 9)], ids=str)
def test_every_choice_solves_the_same_system(shape, linear):
    Q = grid(*shape)
    b = right_hand_sides(int(np.prod(shape)))
    factor, why = factorise(Q, linear, memory=PLENTY)
    assert linear in (why.partition(":")[0], "auto")
    out, expected = np.empty_like(b), np.empty_like(b)
    factor.solve(b, out)
    Supernodal(Q).solve(b, expected)
    # cg ends within 1e-12 of the largest; direct solvers differ by the condition, 1e4 without the pins, times eps
    assert np.abs(out - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("precision", ["float32", "float16"])
@pytest.mark.parametrize("linear", ["auto", "inverse", "supernodal", "cg"])
@pytest.mark.parametrize("shape", [(10, 10), (33, 33)], ids=str)
def test_every_precision_reaches_the_solution_of_float64_by_corrections(shape, linear, precision):
    Q = grid(*shape)
    b = right_hand_sides(int(np.prod(shape)))
    expected, x, step = np.empty_like(b), np.zeros_like(b), np.empty_like(b)
    Supernodal(Q).solve(b, expected)
    factor, _ = factorise(Q, linear, precision, memory=PLENTY)
    for _ in range(30):  # float16 gains two digits at first and a factor of two at least in the worst direction
        factor.solve(b - Q @ x, step)
        x += step
    # The residual is rounded to eps times the condition, 1e4 without the rows of the pins.
    assert np.abs(x - expected).max() <= 1e-10 * np.abs(expected).max()


def test_the_choice_follows_from_the_graph_alone():
    springs = grid_springs(40, 40)
    weak, strong = (network(springs, k, np.ones(1600)) for k in (1e-3, 1e9))
    assert choose(weak, memory=PLENTY).why == choose(strong, memory=PLENTY).why


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(Unsupported, match=r"'lu' is not known; it is one of auto, inverse, cholespy, supernodal, cg"):
        factorise(grid(3, 3), "lu")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_cholespy_is_refused_in_less_than_float64(precision):
    with pytest.raises(Unsupported, match="float64 alone"):
        factorise(grid(3, 3), "cholespy", precision)


@pytest.mark.parametrize("linear", ["auto", "inverse", "supernodal", "cg"])
@pytest.mark.parametrize("side", [10, 20])
def test_no_choice_takes_a_matrix_that_is_not_positive_definite(side, linear):
    Q = grid(side, side)
    Q.data[Q.indptr[5] + np.searchsorted(Q.indices[Q.indptr[5] : Q.indptr[6]], 5)] = -1.0
    with pytest.raises(NotPositiveDefinite, match=r"vertex \d"):
        factorise(Q, linear)


@pytest.mark.parametrize("linear", ["auto", *FORCED])
@pytest.mark.parametrize("side", [10, 20])
def test_no_choice_takes_a_matrix_that_is_not_finite(side, linear):
    Q = grid(side, side)
    Q.data[Q.indptr[7]] = np.nan
    with pytest.raises(NotPositiveDefinite):
        factorise(Q, linear)


def test_an_inverse_is_exact_over_twelve_decades_of_stiffness():
    springs, rng = grid_springs(11, 11), np.random.default_rng(2)
    Q = network(springs, 10.0 ** rng.uniform(0, 12, len(springs)), 10.0 ** rng.uniform(0, 12, 121))
    b, out = right_hand_sides(121), np.empty((121, 3))
    factorise(Q, "inverse")[0].solve(b, out)
    # An inverse solves each equation to its condition times eps: those of 121 vertices to some hundred.
    assert backward_error(Q, out, b) <= 1e-11


def test_an_inverse_solves_no_equations_at_all():
    out = np.empty((0, 3))
    factorise(csr_array((0, 0)), "inverse")[0].solve(np.empty((0, 3)), out)
    assert out.shape == (0, 3)


@pytest.mark.parametrize("n", range(1, 10))
def test_an_inverse_of_every_small_size_is_right(n):
    Q = network([(i, i + 1) for i in range(n - 1)], 2.0, np.ones(n))
    b, out = right_hand_sides(n), np.empty((n, 3))
    factor = factorise(Q, "inverse")[0]
    factor.solve(b, out)
    # a condition of 9 at most
    np.testing.assert_allclose(Q @ out, b, rtol=0, atol=1e-14)
    assert factor.nonzeros == n * (n + 1) // 2


def test_stiffnesses_too_far_apart_for_a_precision_are_solved_in_float64():
    ends = np.array([[0, 1], [1, 2], [2, 3]])
    Q = network(ends, np.array([1e14, 100.0, 1e14]), np.full(4, 0.1))
    factor, why = factorise(Q, "supernodal", "float32", memory=PLENTY)
    assert "in float64, for stiffnesses lie too far apart for float32" in why
    assert isinstance(factor, Supernodal)
    assert factor.squares.dtype == np.float64
    assert "too far apart" not in factorise(grid(10, 10), precision="float16", memory=PLENTY)[1]
