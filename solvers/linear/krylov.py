"""Preconditioned conjugate gradients (Hestenes and Stiefel 1952), once: as Python, and compiled into kernels.

    p = z + (r'z / r'z before) p      x += t p,   r -= t A p,   t = r'z / p'Ap      z = M^-1 r

`over` makes the iteration of what is done to a state, which knows A and M^-1; `compiled_over` the same one for kernels,
and `Iteration` is one whose state is an object of Python. Several right-hand sides are several iterations side by side:
then the scalar products are arrays.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import numpy as np

from solvers.compiling import inner_closure

ITERATIONS, NEAR, CURVED = range(3)
"""What ended an iteration: the limit, that x is near enough, or a curvature p'Ap that A should not have."""


def over(
    turn: Callable[..., Any], go: Callable[..., Any], convex: Callable[..., Any], near: Callable[..., Any]
) -> Callable[..., Any]:
    """The iteration over what is done to a state of which r and z are known.

    turn(state, product, before): p = z + product/before p, and p'Ap; at first `before` is infinite, and p finite.
    go(state, product, curvature): x and r by product/curvature p and A p, then z; r'z. convex(state, curvature):
    whether it goes on along p. near(state, product): whether x will do.
    iterate(state, product, most): from r'z, how many iterations were done, at most so many, and what ended them.
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
    """The same for kernels, over inner ones."""
    return inner_closure(over(*functions))


class Iteration(ABC):
    """A state of which r and z are known; see `over`."""

    @abstractmethod
    def turn(self, product: Any, before: Any) -> Any:
        """p, and p'Ap."""

    @abstractmethod
    def go(self, product: Any, curvature: Any) -> Any:
        """x, r and z, and r'z."""

    def convex(self, curvature: Any) -> bool:
        """Whether it goes on along p; always where A is known to be positive definite."""
        return True

    @abstractmethod
    def near(self, product: Any) -> bool:
        """Whether x will do."""

    def iterate(self, product: Any, most: int) -> tuple[int, int]:
        """See `over`."""
        return _iterate(self, product, most)


_iterate = over(
    lambda state, product, before: state.turn(product, before),
    lambda state, product, curvature: state.go(product, curvature),
    lambda state, curvature: state.convex(curvature),
    lambda state, product: state.near(product),
)
