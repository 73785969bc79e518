"""Element energies by vertex: the gradient and block of one vertex, and the energy change of its step.

    E = sum_e phi_e(z_e),   z = A p       gradient_i = sum_e a_ei phi'(z_e),   block_i = sum_e a_ei^2 phi''(z_e)

with the element laws of `solvers.energies.elements`. If phi'' does not depend on z, a vertex's block B is
constant in the step, and a step d of the vertex changes the energy by g'd + d'Bd/2, with its gradient g. Its elements
are then evaluated once, and not again for the change. Positions have rows of four numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from solvers.compiling import inlined_closure, inner_closure, kernel
from solvers.energies.elements import Elements, Law


class Around(NamedTuple):
    """Elements by the rows of their vertices, and as a list.

    Indices are unsigned, so that compiled code needs no check for negative ones.

    Attributes:
        first: first entry of each row (rows + 1,).
        element, own: of each entry, the element and the row's coefficient in it.
        places, weights: offsets of the other vertices' rows, and their coefficients (entries, k - 1).
        block, pull: for constant phi'', the sum of each row (rows, 6) and its last gradient (rows,
            3).
        rows, coefficients: of the elements (m, k).
        numbers: parameters of phi (m, q).
    """

    first: NDArray[np.uint32]
    element: NDArray[np.uint32]
    own: NDArray[np.float64]
    places: NDArray[np.uint32]
    weights: NDArray[np.float64]
    block: NDArray[np.float64]
    pull: NDArray[np.float64]
    rows: NDArray[np.uint32]
    coefficients: NDArray[np.float64]
    numbers: NDArray[np.float64]

    @classmethod
    def of(cls, law: Law, elements: Elements, row: NDArray[np.int64], rows: int) -> Around:
        """Build the incident elements of rows `row` (n,) of `rows`.

        An element that has a vertex twice is an edge from it to itself, and is omitted from the rows.
        """
        at = row[elements.vertices].astype(np.int64)
        width = at.shape[1]
        ordered = np.sort(at, axis=1)
        apart = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
        element, slot = (x[np.repeat(apart, width)] for x in np.divmod(np.arange(at.size), width))
        order = np.argsort(at[element, slot], kind="stable")
        element, slot = element[order], slot[order]
        others = (slot[:, None] + np.arange(1, width)) % width
        none, c = np.empty((0, 0)), elements.coefficients
        first = np.concatenate([[0], np.cumsum(np.bincount(at[element, slot], minlength=rows))]).astype(np.uint32)
        places, weights = (4 * at[element[:, None], others]).astype(np.uint32), c[element[:, None], others]
        own, element = c[element, slot], element.astype(np.uint32)
        made = cls(first, element, own, places, weights, none, none, at.astype(np.uint32), c, none)
        return made.with_numbers(law, elements)

    def with_numbers(self, law: Law, elements: Elements) -> Around:
        """Return the elements with other parameters."""
        rows = len(self.first) - 1 if law.constant else 0
        block = np.zeros((rows, 6))
        if law.constant:
            curvature = np.empty((len(elements.vertices), 6))
            law.curve(elements, np.zeros((int(elements.vertices.max(initial=-1)) + 1, 3)), curvature)
            _add_up(self.first, self.element, self.own, curvature, block)
        numbers = np.ascontiguousarray(elements.numbers)
        return self._replace(block=block, pull=np.zeros((rows, 3)), numbers=numbers)


@kernel
def _add_up(first, element, own, curvature, block):
    """Add the second derivatives (m, 6) of the elements of each row to its block."""
    for i in range(len(block)):
        for entry in range(first[i], first[i + 1]):
            for k in range(6):
                block[i, k] += own[entry] * own[entry] * curvature[element[entry], k]


class Kind(NamedTuple):
    """Elements of a law that couple `width` vertices each."""

    law: Law
    width: int


class Vertices(NamedTuple):
    """The functions of all kinds for kernels; `around` has incident elements for each kind.

    Attributes:
        total: function (around, p) that returns the energy [J].
        felt: function (around, i, p, gradient, block) that adds the elements of row i; the block is the
            upper triangle, row by row.
        risen: function (around, i, p, d) that returns the energy change [J] by a step d of row i, from the
            positions of the last call of `felt`.
    """

    total: Any
    felt: Any
    risen: Any

    @classmethod
    def of(cls, kinds: list[Kind]) -> Vertices:
        """Build the functions of all kinds together."""
        if not kinds:
            return cls(_no_energy, _unchanged, _no_rise)
        own_total, own_felt, own_risen = cls._of_one(*kinds[0])
        others_total, others_felt, others_risen = cls.of(kinds[1:])

        @inner_closure
        def total(around, p):
            return own_total(around[0], p) + others_total(around[1:], p)

        @inlined_closure
        def felt(around, i, p, gradient, block):
            gradient, block = own_felt(around[0], i, p, gradient, block)
            return others_felt(around[1:], i, p, gradient, block)

        @inlined_closure
        def risen(around, i, p, d):
            return own_risen(around[0], i, p, d) + others_risen(around[1:], i, p, d)

        return cls(total, felt, risen)

    @classmethod
    def _of_one(cls, law: Law, width: int) -> Vertices:
        """Build the functions of one kind, whose width is a compile-time constant."""
        value, gradients, curvature, rise = law.one.value, law.one.gradient, law.one.curvature, law.one.rise

        @inner_closure
        def total(around, p):
            energy = 0.0
            for e in range(len(around.rows)):
                z0 = z1 = z2 = 0.0
                for a in range(width):
                    j, c = 4 * around.rows[e, a], around.coefficients[e, a]
                    z0, z1, z2 = z0 + c * p[j], z1 + c * p[j + 1], z2 + c * p[j + 2]
                energy += value(around.numbers, e, z0, z1, z2)
            return energy

        @inlined_closure
        def seen(around, entry, i, p):
            c = around.own[entry]
            z0, z1, z2 = c * p[4 * i], c * p[4 * i + 1], c * p[4 * i + 2]
            for a in range(width - 1):
                j, w = around.places[entry, a], around.weights[entry, a]
                z0, z1, z2 = z0 + w * p[j], z1 + w * p[j + 1], z2 + w * p[j + 2]
            return z0, z1, z2

        @inlined_closure
        def felt(around, i, p, gradient, block):
            g0, g1, g2 = gradient
            xx, xy, xz, yy, yz, zz = block
            for entry in range(around.first[i], around.first[i + 1]):
                z0, z1, z2 = seen(around, entry, i, p)
                f0, f1, f2 = gradients(around.numbers, around.element[entry], z0, z1, z2)
                h0, h1, h2, h3, h4, h5 = curvature(around.numbers, around.element[entry], z0, z1, z2)
                c = around.own[entry]
                g0, g1, g2, c2 = g0 + c * f0, g1 + c * f1, g2 + c * f2, c * c
                xx, xy, xz, yy, yz, zz = (
                    xx + c2 * h0, xy + c2 * h1, xz + c2 * h2, yy + c2 * h3, yz + c2 * h4, zz + c2 * h5,
                )  # fmt: skip
            return (g0, g1, g2), (xx, xy, xz, yy, yz, zz)

        @inlined_closure
        def risen(around, i, p, d):
            energy = 0.0
            for entry in range(around.first[i], around.first[i + 1]):
                z0, z1, z2 = seen(around, entry, i, p)
                c = around.own[entry]
                energy += rise(around.numbers, around.element[entry], z0, z1, z2, c * d[0], c * d[1], c * d[2])
            return energy

        @inlined_closure
        def felt_by_constant(around, i, p, gradient, block):
            g0 = g1 = g2 = 0.0
            for entry in range(around.first[i], around.first[i + 1]):
                z0, z1, z2 = seen(around, entry, i, p)
                f0, f1, f2 = gradients(around.numbers, around.element[entry], z0, z1, z2)
                c = around.own[entry]
                g0, g1, g2 = g0 + c * f0, g1 + c * f1, g2 + c * f2
            around.pull[i, 0], around.pull[i, 1], around.pull[i, 2] = g0, g1, g2
            xx, xy, xz, yy, yz, zz = block
            return (gradient[0] + g0, gradient[1] + g1, gradient[2] + g2), (
                xx + around.block[i, 0], xy + around.block[i, 1], xz + around.block[i, 2],
                yy + around.block[i, 3], yz + around.block[i, 4], zz + around.block[i, 5],
            )  # fmt: skip

        if law.constant:
            return cls(total, felt_by_constant, _risen_by_constant)
        return cls(total, felt, risen)


@inlined_closure
def _risen_by_constant(around, i, p, d):
    block, pull = around.block, around.pull
    f0 = pull[i, 0] + 0.5 * block[i, 0] * d[0] + block[i, 1] * d[1] + block[i, 2] * d[2]
    f1 = pull[i, 1] + 0.5 * block[i, 3] * d[1] + block[i, 4] * d[2]
    f2 = pull[i, 2] + 0.5 * block[i, 5] * d[2]
    return d[0] * f0 + d[1] * f1 + d[2] * f2


@inner_closure
def _no_energy(around, p):
    return 0.0


@inlined_closure
def _unchanged(around, i, p, gradient, block):
    return gradient, block


@inlined_closure
def _no_rise(around, i, p, d):
    return 0.0
