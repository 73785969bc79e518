"""Element energies by vertex: gradient, block and energy change of one vertex.

    E = sum_e phi_e(z_e),   z = A p       gradient_i = sum_e a_ei phi'(z_e),   block_i = sum_e a_ei^2 phi''(z_e)

with the element laws of `springbench.solvers.model.energies.element_energies`. If phi'' does not depend on z, a
vertex's block B is constant in the step, and a step d of the vertex changes the energy by g'd + d'Bd/2, with its
gradient g. Its elements are then evaluated once, and not again for the change. Positions have rows of four numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.jit.kernel_compilation import jit_closure, jit_inlined_closure, jit_kernel
from springbench.solvers.model.energies.element_energies import ElementLaw, Elements
from springbench.solvers.model.system_matrix_assembly import compute_row_starts


class IncidentElements(NamedTuple):
    """Elements by the rows of their vertices, and as a list.

    Indices are unsigned, so that compiled code needs no check for negative ones.

    Attributes:
        row_starts: first entry of each row (rows + 1,).
        element_index, own_coefficient: of each entry, the element and the row's coefficient in it.
        other_offsets, other_coefficients: offsets of the other vertices' rows, and their coefficients (entries, k - 1).
        constant_block, last_gradient: for constant phi'', the sum of each row (rows, 6) and its last gradient (rows,
            3).
        element_rows, coefficients: of the elements (m, k).
        parameters: parameters of phi (m, q).
    """

    row_starts: NDArray[np.uint32]
    element_index: NDArray[np.uint32]
    own_coefficient: NDArray[np.float64]
    other_offsets: NDArray[np.uint32]
    other_coefficients: NDArray[np.float64]
    constant_block: NDArray[np.float64]
    last_gradient: NDArray[np.float64]
    element_rows: NDArray[np.uint32]
    coefficients: NDArray[np.float64]
    parameters: NDArray[np.float64]

    @classmethod
    def from_elements(cls, law: ElementLaw, elements: Elements, row: NDArray[np.int64], rows: int) -> IncidentElements:
        """Build the incident elements of rows.

        An element that has a vertex twice is an edge from it to itself, and is omitted from the rows.

        Args:
            law: law of the elements.
            elements: elements with vertices and coefficients (m, k).
            row: row of each vertex (n,).
            rows: number of rows.
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
        first = compute_row_starts(at[element, slot], rows).astype(np.uint32)
        places, weights = (4 * at[element[:, None], others]).astype(np.uint32), c[element[:, None], others]
        own, element = c[element, slot], element.astype(np.uint32)
        made = cls(first, element, own, places, weights, none, none, at.astype(np.uint32), c, none)
        return made.with_parameters(law, elements)

    def with_parameters(self, law: ElementLaw, elements: Elements) -> IncidentElements:
        """Return the elements with other parameters.

        Args:
            law: law of the elements, as before.
            elements: the same elements in the same order, with the new parameters (m, q).
        """
        rows = len(self.row_starts) - 1 if law.has_constant_hessian else 0
        block = np.zeros((rows, 6))
        if law.has_constant_hessian:
            curvature = np.empty((len(elements.vertices), 6))
            law.evaluate_hessians(elements, np.zeros((int(elements.vertices.max(initial=-1)) + 1, 3)), curvature)
            _sum_row_blocks(self.row_starts, self.element_index, self.own_coefficient, curvature, block)
        numbers = np.ascontiguousarray(elements.parameters)
        return self._replace(constant_block=block, last_gradient=np.zeros((rows, 3)), parameters=numbers)


@jit_kernel
def _sum_row_blocks(first, element, own, curvature, block):
    """Add the second derivatives (m, 6) of the elements of each row to its block."""
    for i in range(len(block)):
        for entry in range(first[i], first[i + 1]):
            for k in range(6):
                block[i, k] += own[entry] * own[entry] * curvature[element[entry], k]


class ElementKind(NamedTuple):
    """Elements of a law that couple `width` vertices each."""

    element_law: ElementLaw
    width: int


class VertexFunctions(NamedTuple):
    """The functions of all kinds for kernels; `around` has incident elements for each kind.

    Attributes:
        total_energy: function (around, p) that returns the energy [J].
        add_gradient_block: function (around, i, p, gradient, block) that adds the elements of row i; the block is the
            upper triangle, row by row.
        energy_change: function (around, i, p, d) that returns the energy change [J] by a step d of row i, from the
            positions of the last call of `add_gradient_block`.
    """

    total_energy: Any
    add_gradient_block: Any
    energy_change: Any

    @classmethod
    def from_kinds(cls, kinds: list[ElementKind]) -> VertexFunctions:
        """Build the functions of all kinds together."""
        if not kinds:
            return cls(_no_energy, _no_contribution, _no_energy_change)
        own_energy, add_own, own_change = cls._from_kind(*kinds[0])
        other_energy, add_others, other_change = cls.from_kinds(kinds[1:])

        @jit_closure
        def total_energy(around, p):
            return own_energy(around[0], p) + other_energy(around[1:], p)

        @jit_inlined_closure
        def add_gradient_block(around, i, p, gradient, block):
            gradient, block = add_own(around[0], i, p, gradient, block)
            return add_others(around[1:], i, p, gradient, block)

        @jit_inlined_closure
        def energy_change(around, i, p, d):
            return own_change(around[0], i, p, d) + other_change(around[1:], i, p, d)

        return cls(total_energy, add_gradient_block, energy_change)

    @classmethod
    def _from_kind(cls, law: ElementLaw, width: int) -> VertexFunctions:
        """Build the functions of one kind, whose width is a compile-time constant."""
        value, gradients, curvature, rise = (
            law.element_functions.value,
            law.element_functions.gradient,
            law.element_functions.hessian,
            law.element_functions.energy_change,
        )

        @jit_closure
        def total_energy(around, p):
            energy = 0.0
            for e in range(len(around.element_rows)):
                z0 = z1 = z2 = 0.0
                for a in range(width):
                    j, c = 4 * around.element_rows[e, a], around.coefficients[e, a]
                    z0, z1, z2 = z0 + c * p[j], z1 + c * p[j + 1], z2 + c * p[j + 2]
                energy += value(around.parameters, e, z0, z1, z2)
            return energy

        @jit_inlined_closure
        def element_argument(around, entry, i, p):
            c = around.own_coefficient[entry]
            z0, z1, z2 = c * p[4 * i], c * p[4 * i + 1], c * p[4 * i + 2]
            for a in range(width - 1):
                j, w = around.other_offsets[entry, a], around.other_coefficients[entry, a]
                z0, z1, z2 = z0 + w * p[j], z1 + w * p[j + 1], z2 + w * p[j + 2]
            return z0, z1, z2

        @jit_inlined_closure
        def add_gradient_block(around, i, p, gradient, block):
            g0, g1, g2 = gradient
            xx, xy, xz, yy, yz, zz = block
            for entry in range(around.row_starts[i], around.row_starts[i + 1]):
                z0, z1, z2 = element_argument(around, entry, i, p)
                f0, f1, f2 = gradients(around.parameters, around.element_index[entry], z0, z1, z2)
                h0, h1, h2, h3, h4, h5 = curvature(around.parameters, around.element_index[entry], z0, z1, z2)
                c = around.own_coefficient[entry]
                g0, g1, g2, c2 = g0 + c * f0, g1 + c * f1, g2 + c * f2, c * c
                xx, xy, xz, yy, yz, zz = (
                    xx + c2 * h0, xy + c2 * h1, xz + c2 * h2, yy + c2 * h3, yz + c2 * h4, zz + c2 * h5,
                )  # fmt: skip
            return (g0, g1, g2), (xx, xy, xz, yy, yz, zz)

        @jit_inlined_closure
        def energy_change(around, i, p, d):
            energy = 0.0
            for entry in range(around.row_starts[i], around.row_starts[i + 1]):
                z0, z1, z2 = element_argument(around, entry, i, p)
                c = around.own_coefficient[entry]
                energy += rise(around.parameters, around.element_index[entry], z0, z1, z2, c * d[0], c * d[1], c * d[2])
            return energy

        @jit_inlined_closure
        def add_constant_block(around, i, p, gradient, block):
            g0 = g1 = g2 = 0.0
            for entry in range(around.row_starts[i], around.row_starts[i + 1]):
                z0, z1, z2 = element_argument(around, entry, i, p)
                f0, f1, f2 = gradients(around.parameters, around.element_index[entry], z0, z1, z2)
                c = around.own_coefficient[entry]
                g0, g1, g2 = g0 + c * f0, g1 + c * f1, g2 + c * f2
            around.last_gradient[i, 0], around.last_gradient[i, 1], around.last_gradient[i, 2] = g0, g1, g2
            xx, xy, xz, yy, yz, zz = block
            return (gradient[0] + g0, gradient[1] + g1, gradient[2] + g2), (
                xx + around.constant_block[i, 0], xy + around.constant_block[i, 1], xz + around.constant_block[i, 2],
                yy + around.constant_block[i, 3], yz + around.constant_block[i, 4], zz + around.constant_block[i, 5],
            )  # fmt: skip

        if law.has_constant_hessian:
            return cls(total_energy, add_constant_block, _constant_energy_change)
        return cls(total_energy, add_gradient_block, energy_change)


@jit_inlined_closure
def _constant_energy_change(around, i, p, d):
    block, pull = around.constant_block, around.last_gradient
    f0 = pull[i, 0] + 0.5 * block[i, 0] * d[0] + block[i, 1] * d[1] + block[i, 2] * d[2]
    f1 = pull[i, 1] + 0.5 * block[i, 3] * d[1] + block[i, 4] * d[2]
    f2 = pull[i, 2] + 0.5 * block[i, 5] * d[2]
    return d[0] * f0 + d[1] * f1 + d[2] * f2


@jit_closure
def _no_energy(around, p):
    return 0.0


@jit_inlined_closure
def _no_contribution(around, i, p, gradient, block):
    return gradient, block


@jit_inlined_closure
def _no_energy_change(around, i, p, d):
    return 0.0
