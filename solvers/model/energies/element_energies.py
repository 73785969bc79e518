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
from springbench.solvers.jit.kernel_compilation import jit_inner, jit_kernel


class Elements(NamedTuple):
    """Rows of A of one width: vertices (m, k), coefficients (m, k), and parameters of phi (m, q)."""

    vertices: NDArray[np.int64]
    coefficients: NDArray[np.float64]
    parameters: NDArray[np.float64]

    @classmethod
    def from_edges(cls, edges: NDArray[np.int64], *parameters: NDArray[np.float64]) -> Elements:
        """Return elements of edges, with z from second to first end.

        Args:
            edges: vertex pairs (m, 2).
            *parameters: columns of the parameters of phi, (m,) or (m, c) each.
        """
        return cls(edges, np.tile([1.0, -1.0], (len(edges), 1)), np.column_stack(parameters))


class ElementFunctions(NamedTuple):
    """The functions of one element, compiled as inner functions.

    Their arguments are the parameters (m, q), the element e and z0, z1, z2; that of the change also has s0, s1, s2.
    They return phi, its first derivatives (3), its second derivatives (6), and phi(z + s) - phi(z).
    """

    value: Any
    gradient: Any
    hessian: Any
    energy_change: Any


class ElementLaw(NamedTuple):
    """The law of one element as passes over all elements.

    Attributes:
        value: function (elements, p) that returns the energy [J].
        add_gradient: function (elements, p, out) that adds the gradient [N] to `out`, (n, 3).
        energy_change: function (elements, p, q) that returns the change from p to q [J].
        evaluate_hessians: function (elements, p, out) that writes the second derivatives xx, xy, xz, yy, yz, zz of each
            element [N/m] to `out` (m, 6).
        has_constant_hessian: whether the second derivatives do not depend on p.
        element_functions: functions of a single element.
    """

    value: Callable[..., float]
    add_gradient: Callable[..., None]
    energy_change: Callable[..., float]
    evaluate_hessians: Callable[..., None]
    has_constant_hessian: bool
    element_functions: ElementFunctions

    @classmethod
    def from_functions(
        cls, value: Any, gradient: Any, hessian: Any, energy_change: Any, *, has_constant_hessian: bool = False
    ) -> ElementLaw:
        """Build the passes from the functions of a single element.

        Args:
            value, gradient, hessian, energy_change: inner functions of one element: phi(z), its first and second
                derivatives, and phi(z + s) - phi(z).
            has_constant_hessian: whether the second derivatives do not depend on z.
        """

        @jit_kernel
        def values(elements, p):
            total = 0.0
            for e in range(len(elements.vertices)):
                z0, z1, z2 = gather_coordinates(elements, e, p)
                total += value(elements.parameters, e, z0, z1, z2)
            return total

        @jit_kernel
        def add_gradient(elements, p, out):
            for e in range(len(elements.vertices)):
                z0, z1, z2 = gather_coordinates(elements, e, p)
                g0, g1, g2 = gradient(elements.parameters, e, z0, z1, z2)
                for a in range(elements.vertices.shape[1]):
                    i, c = elements.vertices[e, a], elements.coefficients[e, a]
                    out[i, 0] += c * g0
                    out[i, 1] += c * g1
                    out[i, 2] += c * g2

        @jit_kernel
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
                total += energy_change(elements.parameters, e, z0, z1, z2, s0, s1, s2)
            return total

        @jit_kernel
        def curve(elements, p, out):
            for e in range(len(elements.vertices)):
                z0, z1, z2 = gather_coordinates(elements, e, p)
                xx, xy, xz, yy, yz, zz = hessian(elements.parameters, e, z0, z1, z2)
                out[e, 0], out[e, 1], out[e, 2], out[e, 3], out[e, 4], out[e, 5] = xx, xy, xz, yy, yz, zz

        return cls(
            values,
            add_gradient,
            rises,
            curve,
            has_constant_hessian,
            ElementFunctions(value, gradient, hessian, energy_change),
        )


@jit_inner
def gather_coordinates(elements, e, p):
    """Return the three coordinates of z of an element.

    Args:
        elements: the elements, with rows of A.
        e: index of the element.
        p: positions (n, 3) [m].
    """
    z0 = z1 = z2 = 0.0
    for a in range(elements.vertices.shape[1]):
        i, c = elements.vertices[e, a], elements.coefficients[e, a]
        z0, z1, z2 = z0 + c * p[i, 0], z1 + c * p[i, 1], z2 + c * p[i, 2]
    return z0, z1, z2


@jit_inner
def axial_hessian(along, across, n0, n1, n2):
    """Return the Hessian of an element with a stiffness along and one across a direction.

    Args:
        along, across: stiffness along n, and perpendicular to it [N/m].
        n0, n1, n2: coordinates of the unit vector n.

    Returns:
        Second derivatives xx, xy, xz, yy, yz, zz [N/m].
    """
    more = along - across
    return (
        more * n0 * n0 + across, more * n0 * n1, more * n0 * n2,
        more * n1 * n1 + across, more * n1 * n2, more * n2 * n2 + across,
    )  # fmt: skip


class JoinedElements(NamedTuple):
    """The rows of A of many energies.

    Attributes:
        row_starts: index of the first entry of each row (m + 1,).
        vertices, coefficients: of the entries.
    """

    row_starts: NDArray[np.int64]
    vertices: NDArray[np.int64]
    coefficients: NDArray[np.float64]

    @classmethod
    def from_elements(cls, parts: list[Elements]) -> JoinedElements:
        """Concatenate the rows of several energies."""
        widths = [np.full(len(x.vertices), x.vertices.shape[1]) for x in parts]
        return cls(
            np.append(0, np.cumsum(np.concatenate(widths))),
            np.concatenate([x.vertices.ravel() for x in parts]),
            np.concatenate([x.coefficients.ravel() for x in parts]),
        )


@jit_inner
def add_symmetric_block(values, block, factor, xx, xy, xz, yy, yz, zz):
    """Add a multiple of a symmetric block.

    Args:
        values: blocks (b, 3, 3) [N/m], updated.
        block: index of the block.
        factor: multiple.
        xx, xy, xz, yy, yz, zz: upper triangle [N/m].
    """
    values[block, 0, 0] += factor * xx
    values[block, 0, 1] += factor * xy
    values[block, 0, 2] += factor * xz
    values[block, 1, 0] += factor * xy
    values[block, 1, 1] += factor * yy
    values[block, 1, 2] += factor * yz
    values[block, 2, 0] += factor * xz
    values[block, 2, 1] += factor * yz
    values[block, 2, 2] += factor * zz


@jit_kernel
def add_blocks(elements, block_indices, hessians, values):
    """Add the second derivatives of elements to matrix blocks.

    Args:
        elements: the elements.
        block_indices: block of each pair of an element's vertices (m, k^2), -1 for none.
        hessians: second derivatives (m, 6) [N/m].
        values: blocks (b, 3, 3) [N/m], updated.
    """
    width = elements.vertices.shape[1]
    for e in range(len(hessians)):
        xx, xy, xz = hessians[e, 0], hessians[e, 1], hessians[e, 2]
        yy, yz, zz = hessians[e, 3], hessians[e, 4], hessians[e, 5]
        if xx == 0.0 and yy == 0.0 and zz == 0.0:
            continue  # an inactive limit, or an obstacle without contact
        for a in range(width):
            for b in range(width):
                block, c = block_indices[e, a * width + b], elements.coefficients[e, a] * elements.coefficients[e, b]
                if block >= 0:
                    add_symmetric_block(values, block, c, xx, xy, xz, yy, yz, zz)


@jit_inner
def add_products(joined, hessians, x, out):
    """Add the product of all second derivatives with x to `out`.

    Does nothing without elements.

    Args:
        joined: the rows of A of all elements, or None.
        hessians: second derivatives of the elements (m, 6) [N/m]; None without elements.
        x: displacements (n, 3) [m].
        out: sum of products (n, 3) [N], updated.
    """
    if joined is None:
        return
    for e in range(len(hessians)):
        xx, xy, xz = hessians[e, 0], hessians[e, 1], hessians[e, 2]
        yy, yz, zz = hessians[e, 3], hessians[e, 4], hessians[e, 5]
        if xx == 0.0 and yy == 0.0 and zz == 0.0:
            continue
        z0 = z1 = z2 = 0.0
        for a in range(joined.row_starts[e], joined.row_starts[e + 1]):
            i, c = joined.vertices[a], joined.coefficients[a]
            z0, z1, z2 = z0 + c * x[i, 0], z1 + c * x[i, 1], z2 + c * x[i, 2]
        f0 = xx * z0 + xy * z1 + xz * z2
        f1 = xy * z0 + yy * z1 + yz * z2
        f2 = xz * z0 + yz * z1 + zz * z2
        for a in range(joined.row_starts[e], joined.row_starts[e + 1]):
            i, c = joined.vertices[a], joined.coefficients[a]
            out[i, 0] += c * f0
            out[i, 1] += c * f1
            out[i, 2] += c * f2
