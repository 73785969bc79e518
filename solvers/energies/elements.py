"""Energies of many equal elements, compiled from the functions of a single element.

    E(p) = sum_e phi_e(z_e),   z = A p,   grad E = A' grad phi,   Hess E = A' (Hess phi) A

A row of A has a few coefficients: one at an obstacle, +1 and -1 along an edge. An energy provides the law of one
element: phi(z), its first and second derivatives, and its change from z to z + s in a form that avoids cancellation.
From these functions this module builds the passes over all elements. It also builds the entries in block matrices, the
products and the contributions to vertex blocks, which need only the second derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner, kernel


class Elements(NamedTuple):
    """Rows of A of one width: vertices (m, k), coefficients (m, k), and parameters of phi (m, q)."""

    vertices: NDArray[np.int64]
    coefficients: NDArray[np.float64]
    numbers: NDArray[np.float64]

    @classmethod
    def along(cls, edges: NDArray[np.int64], *numbers: NDArray[np.float64]) -> Elements:
        """Return elements of edges (m, 2), z from second to first end, with columns of parameters, (m,) or (m, c)."""
        return cls(edges, np.tile([1.0, -1.0], (len(edges), 1)), np.column_stack(numbers))


class One(NamedTuple):
    """The functions of one element, compiled as inner functions.

    Their arguments are the parameters (m, q), the element e and z0, z1, z2; that of the change also has s0, s1, s2.
    They return phi, its first derivatives (3), its second derivatives (6), and phi(z + s) - phi(z).
    """

    value: Any
    gradient: Any
    curvature: Any
    rise: Any


class Law(NamedTuple):
    """The law of one element as passes over all elements.

    Attributes:
        value: function (elements, p) that returns the energy [J].
        add_gradient: function (elements, p, out) that adds the gradient [N] to `out`, (n, 3).
        rise: function (elements, p, q) that returns the change from p to q [J].
        curve: function (elements, p, out) that writes the second derivatives xx, xy, xz, yy, yz, zz of each
            element [N/m] to `out` (m, 6).
        constant: whether the second derivatives do not depend on p.
        one: functions of a single element.
    """

    value: Callable[..., float]
    add_gradient: Callable[..., None]
    rise: Callable[..., float]
    curve: Callable[..., None]
    constant: bool
    one: One

    @classmethod
    def of(cls, value: Any, gradient: Any, curvature: Any, rise: Any, *, constant: bool = False) -> Law:
        """Build the passes from the functions of a single element (see `One`)."""

        @kernel
        def values(elements, p):
            total = 0.0
            for e in range(len(elements.vertices)):
                z0, z1, z2 = seen(elements, e, p)
                total += value(elements.numbers, e, z0, z1, z2)
            return total

        @kernel
        def add_gradient(elements, p, out):
            for e in range(len(elements.vertices)):
                z0, z1, z2 = seen(elements, e, p)
                g0, g1, g2 = gradient(elements.numbers, e, z0, z1, z2)
                for a in range(elements.vertices.shape[1]):
                    i, c = elements.vertices[e, a], elements.coefficients[e, a]
                    out[i, 0] += c * g0
                    out[i, 1] += c * g1
                    out[i, 2] += c * g2

        @kernel
        def rises(elements, p, q):
            total = 0.0
            for e in range(len(elements.vertices)):
                z0 = z1 = z2 = s0 = s1 = s2 = 0.0
                for a in range(elements.vertices.shape[1]):
                    i, c = elements.vertices[e, a], elements.coefficients[e, a]
                    z0, z1, z2 = z0 + c * p[i, 0], z1 + c * p[i, 1], z2 + c * p[i, 2]
                    s0 += c * (q[i, 0] - p[i, 0])
                    s1 += c * (q[i, 1] - p[i, 1])
                    s2 += c * (q[i, 2] - p[i, 2])
                total += rise(elements.numbers, e, z0, z1, z2, s0, s1, s2)
            return total

        @kernel
        def curve(elements, p, out):
            for e in range(len(elements.vertices)):
                z0, z1, z2 = seen(elements, e, p)
                xx, xy, xz, yy, yz, zz = curvature(elements.numbers, e, z0, z1, z2)
                out[e, 0], out[e, 1], out[e, 2], out[e, 3], out[e, 4], out[e, 5] = xx, xy, xz, yy, yz, zz

        return cls(values, add_gradient, rises, curve, constant, One(value, gradient, curvature, rise))


@inner
def seen(elements, e, p):
    """Return z of element e at p (n, 3)."""
    z0 = z1 = z2 = 0.0
    for a in range(elements.vertices.shape[1]):
        i, c = elements.vertices[e, a], elements.coefficients[e, a]
        z0, z1, z2 = z0 + c * p[i, 0], z1 + c * p[i, 1], z2 + c * p[i, 2]
    return z0, z1, z2


@inner
def line(along, across, n0, n1, n2):
    """Return the Hessian with stiffness `along` the unit vector n and stiffness `across` perpendicular to it."""
    more = along - across
    return (
        more * n0 * n0 + across, more * n0 * n1, more * n0 * n2,
        more * n1 * n1 + across, more * n1 * n2, more * n2 * n2 + across,
    )  # fmt: skip


class Joined(NamedTuple):
    """The rows of A of many energies.

    Attributes:
        first: index of the first entry of each row (m + 1,).
        vertices, coefficients: of the entries.
    """

    first: NDArray[np.int64]
    vertices: NDArray[np.int64]
    coefficients: NDArray[np.float64]

    @classmethod
    def of(cls, parts: list[Elements]) -> Joined:
        """Concatenate the rows of several energies."""
        widths = [np.full(len(x.vertices), x.vertices.shape[1]) for x in parts]
        return cls(
            np.append(0, np.cumsum(np.concatenate(widths))),
            np.concatenate([x.vertices.ravel() for x in parts]),
            np.concatenate([x.coefficients.ravel() for x in parts]),
        )


@kernel
def add_blocks(elements, places, curvature, values):
    """Add the second derivatives (m, 6) of elements to matrix blocks (b, 3, 3).

    Args:
        elements: the elements.
        places: block of each pair of an element's vertices (m, k^2), -1 for none.
        curvature: second derivatives (m, 6) [N/m].
        values: blocks (b, 3, 3) [N/m].
    """
    width = elements.vertices.shape[1]
    for e in range(len(curvature)):
        xx, xy, xz = curvature[e, 0], curvature[e, 1], curvature[e, 2]
        yy, yz, zz = curvature[e, 3], curvature[e, 4], curvature[e, 5]
        if xx == 0.0 and yy == 0.0 and zz == 0.0:
            continue  # a limit that is not reached, an obstacle that is not touched
        for a in range(width):
            for b in range(width):
                block, c = places[e, a * width + b], elements.coefficients[e, a] * elements.coefficients[e, b]
                if block < 0:
                    continue
                values[block, 0, 0] += c * xx
                values[block, 0, 1] += c * xy
                values[block, 0, 2] += c * xz
                values[block, 1, 0] += c * xy
                values[block, 1, 1] += c * yy
                values[block, 1, 2] += c * yz
                values[block, 2, 0] += c * xz
                values[block, 2, 1] += c * yz
                values[block, 2, 2] += c * zz


@inner
def add_products(joined, curvature, x, out):
    """Add the product [N] of all second derivatives with x [m], (n, 3), to `out`.

    Does nothing without elements.
    """
    if joined is None:
        return
    for e in range(len(curvature)):
        xx, xy, xz = curvature[e, 0], curvature[e, 1], curvature[e, 2]
        yy, yz, zz = curvature[e, 3], curvature[e, 4], curvature[e, 5]
        if xx == 0.0 and yy == 0.0 and zz == 0.0:
            continue
        z0 = z1 = z2 = 0.0
        for a in range(joined.first[e], joined.first[e + 1]):
            i, c = joined.vertices[a], joined.coefficients[a]
            z0, z1, z2 = z0 + c * x[i, 0], z1 + c * x[i, 1], z2 + c * x[i, 2]
        f0 = xx * z0 + xy * z1 + xz * z2
        f1 = xy * z0 + yy * z1 + yz * z2
        f2 = xz * z0 + yz * z1 + zz * z2
        for a in range(joined.first[e], joined.first[e + 1]):
            i, c = joined.vertices[a], joined.coefficients[a]
            out[i, 0] += c * f0
            out[i, 1] += c * f1
            out[i, 2] += c * f2
