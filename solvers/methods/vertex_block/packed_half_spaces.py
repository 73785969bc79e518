"""Half-spaces of contact in the order of vertex-block packets.

`springbench.solvers.contact.half_space.half_space_steps` uses them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.contact.half_space.half_space_potential import ContactPlanes, HalfSpaceContact
from springbench.solvers.contact.half_space.half_space_steps import HalfSpaces
from springbench.solvers.contact.half_space.vertex_contact import VertexContactEnergy
from springbench.solvers.kernels.spring_local_step import SpringPackets
from springbench.solvers.simd.spring_packets import LANES


def pack_half_spaces(
    contacts: list[VertexContactEnergy], row: NDArray[np.int64], spring_packets: SpringPackets, num_unknowns: int
) -> HalfSpaces:
    """Pack the half-spaces of the current step.

    Args:
        contacts: vertex contacts of the step.
        row: row of each vertex; the first rows are the unknowns.
        spring_packets: packets of the springs.
        num_unknowns: number of rows that are unknowns.
    """
    known = [contact for contact in contacts if isinstance(contact, HalfSpaceContact)]
    fields = [np.concatenate(field) for field in zip(*(contact.active_planes for contact in known), strict=True)]
    slip = np.concatenate([np.full(len(contact.active_planes.vertices), contact.smoothing_length) for contact in known])
    return pack_contact_planes(ContactPlanes(*fields), slip, row, spring_packets, num_unknowns, is_two_sided=False)


def pack_contact_planes(
    planes: ContactPlanes,
    smoothing_length: NDArray[np.float64],
    row: NDArray[np.int64],
    spring_packets: SpringPackets,
    num_unknowns: int,
    *,
    is_two_sided: bool,
) -> HalfSpaces:
    """Pack contact planes.

    Args:
        planes: the half-spaces.
        smoothing_length: smoothing length of friction of each half-space [m], (k,).
        row: row of each vertex; the first rows are the unknowns.
        spring_packets: packets of the springs.
        num_unknowns: number of rows that are unknowns.
        is_two_sided: whether the planes act from both sides.
    """
    vertices, normal, offset, anchor, stiffness, friction_force = planes
    rows = row[vertices]
    order = np.argsort(rows, kind="stable")
    order = order[rows[order] < num_unknowns]
    count = np.bincount(rows[order], minlength=len(row) + 2)
    near = count[spring_packets.row_offset // 4].reshape(-1, LANES).max(axis=1, initial=0) > 0
    first = np.concatenate([[0], np.cumsum(count)])
    ordered: Any = (
        np.ascontiguousarray(x[order]) for x in (normal, anchor, offset, stiffness, friction_force, smoothing_length)
    )
    return HalfSpaces(first, near, *ordered, is_two_sided=is_two_sided)
