"""Preconditioned conjugate gradients (Hestenes and Stiefel 1952), written once for Python and for compiled kernels.

    p = z + (r'z / previous r'z) p      x += t p,   r -= t A p,   t = r'z / p'Ap      z = M^-1 r

`over` builds the iteration from operations on a state, which contains A and M^-1. `compiled_over` builds it
for kernels. `Iteration` is a base class for states that are Python objects. Several right-hand sides
are iterated in lockstep; the scalar products are then arrays.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from solvers.compiling import inner_closure

ITERATIONS, NEAR, CURVED = range(3)
"""Reasons for the end of an iteration: the limit, convergence, or a curvature p'Ap that a definite A cannot have."""


def over(
    turn: Callable[..., Any], go: Callable[..., Any], convex: Callable[..., Any], near: Callable[..., Any]
) -> Callable[..., Any]:
    """Build the iteration from operations on a state with known r and z.

    Args:
        turn: (state, product, before) -> p'Ap; sets p = z + product/before p. At first
            the previous product is infinite, and p finite.
        go: (state, product, curvature) -> r'z; changes x and r by product/curvature times p and A p,
            then z.
        convex: (state, curvature) -> whether the iteration may continue along p.
        near: (state, product) -> whether x is accurate enough.

    Returns:
        Function (state, product, max_iterations) -> number of iterations and the reason for their end; product is r'z.
    """

    def iterate(state: Any, product: Any, most: int) -> tuple[int, int]:
        count, before = 0, np.inf
        while not near(state, product):
            if count == most:
                return count, ITERATIONS
            curvature = turn(state, product, before)
            if not convex(state, curvature):
                return count, CURVED
            before, product = product, go(state, product, curvature)
            count += 1
        return count, NEAR

    return iterate


def compiled_over(*functions: Callable[..., Any]) -> Any:
    """Build the iteration for kernels, from inlined kernels."""
    return inner_closure(over(*functions))


class Iteration(ABC):
    """Base class of a state with known r and z (see `over`)."""

    @abstractmethod
    def turn(self, product: Any, before: Any) -> Any:
        """Update p, and return p'Ap."""

    @abstractmethod
    def go(self, product: Any, curvature: Any) -> Any:
        """Update x, r and z, and return r'z."""

    def convex(self, curvature: Any) -> bool:
        """Return whether the iteration may continue along p; always if A is known to be positive definite."""
        return True

    @abstractmethod
    def near(self, product: Any) -> bool:
        """Return whether x is accurate enough."""

    def iterate(self, product: Any, most: int) -> tuple[int, int]:
        """Iterate from the product r'z; return the number of iterations and the reason for their end."""
        return _iterate(self, product, most)


_iterate = over(
    lambda state, product, before: state.turn(product, before),
    lambda state, product, curvature: state.go(product, curvature),
    lambda state, curvature: state.convex(curvature),
    lambda state, product: state.near(product),
)
