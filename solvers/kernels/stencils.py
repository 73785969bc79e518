"""Energies of elements by their vertices: what one vertex feels of them, and what a step of it alone changes.

    E = sum_e phi_e(z_e),   z = A p       gradient_i = sum_e a_ei phi'(z_e),   block_i = sum_e a_ei^2 phi''(z_e)

with the laws of one element that `solvers.energies.elements` has. Positions have rows of four numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inner_closure
from solvers.energies.elements import Elements, Law, One


class Around(NamedTuple):
    """Elements by the rows of their vertices.

    first (rows + 1,): the first entry of each row; element, slot: of each entry, and which of its vertices the row is;
    rows, coefficients (m, k): of the elements; numbers (m, q): what phi reads.
    """

    first: NDArray[np.int64]
    element: NDArray[np.int64]
    slot: NDArray[np.int64]
    rows: NDArray[np.int64]
    coefficients: NDArray[np.float64]
    numbers: NDArray[np.float64]

    @classmethod
    def of(cls, elements: Elements, row: NDArray[np.int64], rows: int) -> Around:
        """Elements of vertices in rows `row` (n,), of so many; one that names a vertex twice is an edge from it to
        itself, and nobody feels it."""
        at = row[elements.vertices].astype(np.int64)
        ordered = np.sort(at, axis=1)
        apart = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
        element, slot = (x[np.repeat(apart, at.shape[1])] for x in np.divmod(np.arange(at.size), at.shape[1]))
        here = at[element, slot]
        order = np.argsort(here, kind="stable")
        first = np.concatenate([[0], np.cumsum(np.bincount(here, minlength=rows))])
        return cls(
            first, element[order], slot[order], at, elements.coefficients, np.ascontiguousarray(elements.numbers)
        )


class Vertices(NamedTuple):
    """What all laws say, as functions for kernels; `around` has an Around for each law.

    total(around, p): the energy [J]; felt(around, i, p, gradient, block): with what row i feels added, of the block the
    upper triangle, row by row; risen(around, i, p, d): the rise [J] by a step d of row i.
    """

    total: Any
    felt: Any
    risen: Any

    @classmethod
    def of(cls, laws: list[Law]) -> Vertices:
        """The functions of all laws together."""
        if not laws:
            return cls(_no_energy, _unchanged, _no_rise)
        own_total, own_felt, own_risen = cls._of_one(laws[0].one)
        others_total, others_felt, others_risen = cls.of(laws[1:])

        @inner_closure
        def total(around, p):
            return own_total(around[0], p) + others_total(around[1:], p)

        @inner_closure
        def felt(around, i, p, gradient, block):
            gradient, block = own_felt(around[0], i, p, gradient, block)
            return others_felt(around[1:], i, p, gradient, block)

        @inner_closure
        def risen(around, i, p, d):
            return own_risen(around[0], i, p, d) + others_risen(around[1:], i, p, d)

        return cls(total, felt, risen)

    @classmethod
    def _of_one(cls, one: One) -> Vertices:
        """The functions of one law, which take its Around alone."""
        value, gradients, curvature, rise = one.value, one.gradient, one.curvature, one.rise

        @inner_closure
        def total(around, p):
            energy = 0.0
            for e in range(len(around.rows)):
                z0, z1, z2 = _seen(around, e, p)
                energy += value(around.numbers, e, z0, z1, z2)
            return energy

        @inner_closure
        def felt(around, i, p, gradient, block):
            g0, g1, g2 = gradient
            xx, xy, xz, yy, yz, zz = block
            for entry in range(around.first[i], around.first[i + 1]):
                e = around.element[entry]
                c = around.coefficients[e, around.slot[entry]]
                z0, z1, z2 = _seen(around, e, p)
                f0, f1, f2 = gradients(around.numbers, e, z0, z1, z2)
                h0, h1, h2, h3, h4, h5 = curvature(around.numbers, e, z0, z1, z2)
                g0, g1, g2, c2 = g0 + c * f0, g1 + c * f1, g2 + c * f2, c * c
                xx, xy, xz, yy, yz, zz = (
                    xx + c2 * h0, xy + c2 * h1, xz + c2 * h2, yy + c2 * h3, yz + c2 * h4, zz + c2 * h5,
                )  # fmt: skip
            return (g0, g1, g2), (xx, xy, xz, yy, yz, zz)

        @inner_closure
        def risen(around, i, p, d):
            energy = 0.0
            for entry in range(around.first[i], around.first[i + 1]):
                e = around.element[entry]
                c = around.coefficients[e, around.slot[entry]]
                z0, z1, z2 = _seen(around, e, p)
                energy += rise(around.numbers, e, z0, z1, z2, c * d[0], c * d[1], c * d[2])
            return energy

        return cls(total, felt, risen)


@inner_closure
def _no_energy(around, p):
    return 0.0


@inner_closure
def _unchanged(around, i, p, gradient, block):
    return gradient, block


@inner_closure
def _no_rise(around, i, p, d):
    return 0.0


@inner_closure
def _seen(around, e, p):
    """z of element e."""
    z0 = z1 = z2 = 0.0
    for a in range(around.rows.shape[1]):
        i, c = 4 * around.rows[e, a], around.coefficients[e, a]
        z0, z1, z2 = z0 + c * p[i], z1 + c * p[i + 1], z2 + c * p[i + 2]
    return z0, z1, z2
