"""Preconditioned conjugate gradients (Hestenes and Stiefel 1952), written once for Python and for compiled kernels.

    p = z + (r'z / previous r'z) p      x += t p,   r -= t A p,   t = r'z / p'Ap      z = M^-1 r

`make_cg_loop` builds the iteration from operations on a state, which contains A and M^-1. `compile_cg_loop` builds it
for kernels. `ConjugateGradientIteration` is a base class for states that are Python objects. Several right-hand sides
are iterated in lockstep; the scalar products are then arrays.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np
from springbench.solvers.jit.kernel_compilation import jit_closure

ITERATION_LIMIT, CONVERGED, NEGATIVE_CURVATURE = range(3)
"""Reasons for the end of an iteration: the limit, convergence, or a curvature p'Ap that a definite A cannot have."""


def make_cg_loop(
    update_direction: Callable[..., Any],
    update_iterate: Callable[..., Any],
    is_convex: Callable[..., Any],
    is_converged: Callable[..., Any],
) -> Callable[..., Any]:
    """Build the iteration from operations on a state with known r and z.

    Args:
        update_direction: (state, product, previous_product) -> p'Ap; sets p = z + product/previous_product p. At first
            the previous product is infinite, and p finite.
        update_iterate: (state, product, curvature) -> r'z; changes x and r by product/curvature times p and A p,
            then z.
        is_convex: (state, curvature) -> whether the iteration may continue along p.
        is_converged: (state, product) -> whether x is accurate enough.

    Returns:
        Function (state, product, max_iterations) -> number of iterations and the reason for their end; product is r'z.
    """

    def iterate(state: Any, product: Any, most: int) -> tuple[int, int]:
        count, before = 0, np.inf
        while not is_converged(state, product):
            if count == most:
                return count, ITERATION_LIMIT
            curvature = update_direction(state, product, before)
            if not is_convex(state, curvature):
                return count, NEGATIVE_CURVATURE
            before, product = product, update_iterate(state, product, curvature)
            count += 1
        return count, CONVERGED

    return iterate


def compile_cg_loop(*functions: Callable[..., Any]) -> Any:
    """Build the iteration for kernels, from inlined kernels."""
    return jit_closure(make_cg_loop(*functions))


class ConjugateGradientIteration(ABC):
    """Base class of a state with known residual r and preconditioned residual z."""

    @abstractmethod
    def update_direction(self, product: Any, previous_product: Any) -> Any:
        """Update p, and return p'Ap.

        Args:
            product: r'z of the iterate.
            previous_product: r'z of the iterate before; infinite at first.
        """

    @abstractmethod
    def update_iterate(self, product: Any, curvature: Any) -> Any:
        """Update x, r and z, and return r'z.

        Args:
            product: r'z before the update.
            curvature: p'Ap of the current direction.
        """

    def is_convex(self, curvature: Any) -> bool:
        """Return whether the iteration may continue along p; always for a positive definite A."""
        return True

    @abstractmethod
    def is_converged(self, product: Any) -> bool:
        """Return whether x is accurate enough."""

    def run_iterations(self, product: Any, max_iterations: int) -> tuple[int, int]:
        """Iterate to convergence, negative curvature or the limit.

        Args:
            product: r'z of the initial x; an array for several right-hand sides.
            max_iterations: largest number of iterations.

        Returns:
            The number of iterations, and the reason for their end: ITERATION_LIMIT, CONVERGED or NEGATIVE_CURVATURE.
        """
        return _run_cg_loop(self, product, max_iterations)


_run_cg_loop = make_cg_loop(
    lambda state, product, before: state.update_direction(product, before),
    lambda state, product, curvature: state.update_iterate(product, curvature),
    lambda state, curvature: state.is_convex(curvature),
    lambda state, product: state.is_converged(product),
)
