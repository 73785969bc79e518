"""Half-spaces of contact in the order of vertex-block packets (see `solvers.kernels.half_spaces`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from solvers.contact.energy import Contact, Planes
from solvers.contact.touching import ContactEnergy
from solvers.kernels.half_spaces import HalfSpaces
from solvers.kernels.springs import Bundles
from solvers.vectors.springs import LANES


def half_spaces(contacts: list[ContactEnergy], row: NDArray[np.int64], bundles: Bundles, unknowns: int) -> HalfSpaces:
    """Pack the half-spaces of the current step.

    Args:
        contacts: vertex contacts of the step.
        row: row of each vertex; the first rows are the unknowns.
        bundles: packets of the springs.
        unknowns: number of rows that are unknowns.
    """
    known = [contact for contact in contacts if isinstance(contact, Contact)]
    fields = [np.concatenate(field) for field in zip(*(contact.planes for contact in known), strict=True)]
    slip = np.concatenate([np.full(len(contact.planes.vertices), contact.slip) for contact in known])
    return of_planes(Planes(*fields), slip, row, bundles, unknowns, both=False)


def of_planes(
    planes: Planes, slip: NDArray[np.float64], row: NDArray[np.int64], bundles: Bundles, unknowns: int, *, both: bool
) -> HalfSpaces:
    """Pack contact planes.

    Args:
        planes: the half-spaces.
        slip: smoothing length of friction of each half-space [m], (k,).
        row: row of each vertex; the first rows are the unknowns.
        bundles: packets of the springs.
        unknowns: number of rows that are unknowns.
        both: whether the planes act from both sides.
    """
    vertices, normal, offset, anchor, stiffness, grip = planes
    rows = row[vertices]
    order = np.argsort(rows, kind="stable")
    order = order[rows[order] < unknowns]
    count = np.bincount(rows[order], minlength=len(row) + 2)
    near = count[bundles.own // 4].reshape(-1, LANES).max(axis=1, initial=0) > 0
    first = np.concatenate([[0], np.cumsum(count)])
    ordered: Any = (np.ascontiguousarray(x[order]) for x in (normal, anchor, offset, stiffness, grip, slip))
    return HalfSpaces(first, near, *ordered, both=both)
