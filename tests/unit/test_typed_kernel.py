"""Calls of kernels whose argument types do not change."""

from __future__ import annotations

import numpy as np
import pytest
from springbench.solvers.jit.typed_kernel import TypedKernel, as_kernel_array
from springbench.solvers.kernels.objective_kernels import compute_max_magnitude
from springbench.solvers.kernels.quadratic_form_kernels import multiply_matrix

POSITIONS = np.random.default_rng(0).normal(size=(5, 3))


def test_later_calls_use_the_code_of_the_first_one():
    kernel = TypedKernel(compute_max_magnitude)
    for p in (POSITIONS, -2.0 * POSITIONS, POSITIONS[:0]):
        assert kernel.call(p) == np.abs(p).max(initial=0.0)
        assert kernel.call in [code.entry_point for code in compute_max_magnitude.overloads.values()]


def test_each_one_has_the_types_of_its_own_first_call():
    pointers, out = np.array([0, 1, 2]), np.empty((2, 3))
    for index in (np.int32, np.int64):
        kernel = TypedKernel(multiply_matrix)
        for factor in (1.0, 3.0):
            kernel.call(pointers, np.array([1, 0], index), np.array([factor, 2.0]), POSITIONS, out)
            np.testing.assert_array_equal(out, [factor * POSITIONS[1], 2.0 * POSITIONS[0]])


@pytest.mark.parametrize("place", range(5))
def test_the_largest_magnitude_is_no_number_if_a_coordinate_is_none(place):
    p = POSITIONS.copy()
    p[place, 1] = np.nan
    assert np.isnan(compute_max_magnitude(p))


def test_arrays_that_kernels_do_not_take_are_copied():
    assert as_kernel_array(POSITIONS) is POSITIONS
    fixed = POSITIONS.copy()
    fixed.setflags(write=False)
    for x in (fixed, POSITIONS[::2], np.asfortranarray(POSITIONS)):
        found = as_kernel_array(x)
        assert found.flags.carray
        np.testing.assert_array_equal(found, x)
