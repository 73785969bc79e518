"""The two passes over one panel, against NumPy's products."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit  # noqa: TID251
from springbench.solvers.linalg.cholesky.triangular_solve import backward_substitution, forward_substitution
from springbench.solvers.linalg.memory import allocate_aligned

TYPES = {"float64": (np.float64, 1e-12), "float32": (np.float32, 1e-5), "float16": (np.float32, 1e-5)}
"""The work vector's type for panels of each precision, and the round-off to allow in sums of some 40 numbers of 1."""

ROWS = 96


@njit
def go_forwards(panels, index, chunks, work):
    forward_substitution(panels, index, chunks, 0, len(chunks), work)


@njit
def go_backwards(squares, panels, index, chunks, work):
    backward_substitution(squares, panels, index, chunks, 0, len(chunks), work)


def tiles(W):
    """A panel's entries as kernels want them: rows by fours, each four column by column."""
    return W.reshape(-1, 4, W.shape[1]).transpose(0, 2, 1).ravel()


@pytest.mark.parametrize("below", [0, 4, 8, 24])
@pytest.mark.parametrize("quads", [1, 2, 3, 4])
@pytest.mark.parametrize("precision", TYPES)
def test_a_pass_over_a_panel_is_a_product_with_it(precision, quads, below):
    rng = np.random.default_rng(quads)
    (kind, close), width, first, offset, at = TYPES[precision], 4 * quads, 3, 7, 5
    W, S = rng.normal(size=(below, width)).astype(precision), rng.normal(size=(width, width)).astype(kind)
    panels, squares = np.full(offset + W.size, np.nan, precision), np.full(offset + S.size, np.nan, kind)
    panels[offset:], squares[offset:] = tiles(W), tiles(S)
    if precision == "float16":
        panels = panels.view(np.uint16)
    names = 30 + rng.permutation(60)[:below]
    index = np.concatenate([np.full(at, ROWS), names]).astype(np.int32)
    chunks = np.array([[offset, offset, at, width, below, quads, first]])
    before = np.zeros((ROWS, 4))
    before[:, :3] = rng.normal(size=(ROWS, 3)).astype(kind)
    W, S, own = W.astype(float), S.astype(float), slice(first, first + width)

    work, expected = allocate_aligned(4 * ROWS, kind), before.copy()
    work[:] = before.ravel()
    go_forwards(panels, index, chunks, work)
    expected[names] += W @ before[own]
    np.testing.assert_allclose(work.reshape(-1, 4), expected, rtol=0, atol=close * width)

    work[:], expected = before.ravel(), before.copy()
    go_backwards(squares, panels, index, chunks, work)
    expected[own] = S.T @ before[own] + W.T @ before[names]
    np.testing.assert_allclose(work.reshape(-1, 4), expected, rtol=0, atol=close * width)
