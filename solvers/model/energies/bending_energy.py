"""Quadratic bending of nearly inextensible surfaces that are flat at rest.

The energy is that of Bergou et al. 2006 and Wardetzky et al. 2007, with two differences (see below):

    E(x) = B/2 sum over inner edges of |K x|^2 / (A0 + A1),   K = (c03 + c04, c01 + c02, -c01 - c03, -c02 - c04)

over the flap of an inner edge x0 x1 and the two opposite corners x2, x3, with the cotangents c of the flap's angles at
the edge and the areas A0, A1 of its triangles, all at rest. 3 K x / (A0 + A1) is the mean Laplacian over the flap, and
the matrix is constant. The two differences are:

* The papers have the factor 3/(A0 + A1). On lattices of right or of equilateral triangles the sum is then the integral
  of the squared curvature for a sphere, and three times that for a cylinder, which is the usual shape of bent cloth.
  Here a cylinder has the energy B/2 k^2 per unit area, like a beam of flexural rigidity B per unit width.
* A rectangle cut by one diagonal couples bending with twist, so that a strip under its weight would curl sideways and
  sag by a quarter more. Here rectangles count as cut by either diagonal, half each. A lattice of squares then resists
  twice as much along its diagonals as along its lines.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.solvers.model.energies.quadratic_energy import Quadratic
from springbench.solvers.model.step_problem import Positions

IndexArray = NDArray[np.int64]

_RECTANGLE_TOLERANCE = 1e-6
"""Diagonals whose lengths differ by no more than this fraction count as equal."""


class Bending(Quadratic):
    """The bending energy of a surface."""

    @classmethod
    def from_rest_shape(cls, rest: Positions, triangles: IndexArray, stiffness: float) -> Bending:
        """Return the bending energy of a triangulated surface.

        Args:
            rest: rest positions (n, 3) [m].
            triangles: (f, 3), with positive areas; at most two share an edge.
            stiffness: flexural rigidity B [N m].
        """
        parts = [_flap_stencils(rest, find_flaps(cut)) for cut in _triangulations(rest, triangles)]
        A = scipy.sparse.csr_array(scipy.sparse.vstack([K for K, _ in parts]))
        weight = np.concatenate([stiffness / len(parts) / area for _, area in parts])
        return cls(A, weight, np.zeros((len(weight), 3)))


def find_flaps(triangles: IndexArray) -> IndexArray:
    """Return the edges that two triangles share, with the opposite corners, (h, 4)."""
    edges = np.concatenate([triangles[:, [k, (k + 1) % 3, (k + 2) % 3]] for k in range(3)])
    edges[:, :2].sort(axis=1)
    edges = edges[np.lexsort((edges[:, 1], edges[:, 0]))]
    first = np.flatnonzero((edges[1:, :2] == edges[:-1, :2]).all(axis=1))
    return np.column_stack([edges[first], edges[first + 1, 2]])


def _triangulations(rest: Positions, triangles: IndexArray) -> Iterator[IndexArray]:
    """Yield the triangles, then the triangulation with the other diagonal of all rectangles.

    The second one is omitted if there are no rectangles.
    """
    yield triangles
    a, b, c, d = find_flaps(triangles).T
    diagonal, other = (np.linalg.norm(rest[i] - rest[j], axis=1) for i, j in ((a, b), (c, d)))
    middle = np.linalg.norm(rest[a] + rest[b] - rest[c] - rest[d], axis=1)
    rectangle = np.maximum(np.abs(diagonal - other), middle) <= _RECTANGLE_TOLERANCE * diagonal
    if rectangle.any():
        a, b, c, d = (x[rectangle] for x in (a, b, c, d))
        cut = np.sort(np.concatenate([np.stack(corners, axis=1) for corners in ((a, b, c), (a, b, d))]), axis=1)
        n = len(rest)
        names, given = ((t[:, 0] * n + t[:, 1]) * n + t[:, 2] for t in (cut, np.sort(triangles, axis=1)))
        remaining = triangles[~np.isin(given, names)]
        yield np.concatenate([remaining, np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1)])


def _flap_stencils(rest: Positions, flap: IndexArray) -> tuple[scipy.sparse.csr_array, NDArray[np.float64]]:
    """Return K of each flap (h, 4) as rows (h, n), and the areas A0 + A1 (h,) [m^2]."""
    x0, x1, x2, x3 = (rest[corner] for corner in flap.T)
    c01, c02 = _corner_cotangents(x1 - x0, x2 - x0), _corner_cotangents(x1 - x0, x3 - x0)
    c03, c04 = _corner_cotangents(x0 - x1, x2 - x1), _corner_cotangents(x0 - x1, x3 - x1)
    K = np.stack([c03 + c04, c01 + c02, -c01 - c03, -c02 - c04], axis=1)
    entries = np.repeat(np.arange(len(flap)), 4), flap.ravel()
    rows = scipy.sparse.csr_array(scipy.sparse.coo_array((K.ravel(), entries), shape=(len(flap), len(rest))))
    return rows, _triangle_areas(x1 - x0, x2 - x0) + _triangle_areas(x1 - x0, x3 - x0)


def _triangle_areas(u: Positions, v: Positions) -> NDArray[np.float64]:
    return 0.5 * np.linalg.norm(np.cross(u, v), axis=1)


def _corner_cotangents(u: Positions, v: Positions) -> NDArray[np.float64]:
    return np.einsum("ij,ij->i", u, v) / (2.0 * _triangle_areas(u, v))
