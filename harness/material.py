"""Stiffness of the springs [N/m] from material constants and a rule of how they follow the mesh.

fixed        The constants are the stiffness of each spring [N/m], whatever the mesh.

continuum    The material stays the same when the mesh is refined. With h the spacing:
    dimension 1   k_e = EA / rest length; constants EA [N]. Springs in series add up to EA / L.
    dimension 2   k_e constant; constants [N/m]. There are 1/h springs across a metre of width, so that the
                  force per width and strain is k / h * h = k. With both diagonals, of constant s:
                  C11 = k + s, C12 = C66 = s [N/m].
    dimension 3   k_e = E h; constants [Pa]. There are 1/h^2 springs across a square metre, so that the
                  force per area and strain is k h / h^2 = E. With the diagonals of a block, of constant S:
                  C11 = E + 10/3 S, C12 = C66 = 7/3 S [Pa].
    These are the limits. Springs on the boundary have cells on one side only and yet full stiffness, so that
    a cloth of width W is stiffer by up to h / W, a block by up to that for each side of its cross-section.
    bending       k_e = 16 B / h^2, constant B [N m] (BEND springs, rest length 2h, in dimension 2).

    Skip-one springs have no quadratic bending energy about a flat sheet: a fold by the angle t shortens one
    by 2h (1 - cos(t/2)), h t^2/4 to leading order, and a metre of fold has 1/h of them, which store
    k h t^4/32. A sheet of bending stiffness B that takes the same fold over one spacing stores
    B (t/h)^2 h/2 = B t^2/(2h). The two agree at t = 1 rad for k = 16 B / h^2. The price: gentler bends are
    underestimated by the factor t^2 (a fixed curvature c makes t = c h, so that smooth bends get softer as
    the mesh is refined), and the springs resist stretch too: they add 4 k_e = 64 B / h^2 to the membrane
    stiffness along the lines of the mesh, without bound as h falls. So bending does not converge under
    refinement, unlike the other constants. This rule is our own.

liu2013      k_e = constant * (resolution - 1) / (reference - 1), constants [N/m] as they are at the size
    `reference`: Liu et al. 2013 give their curtain 150, 300, 600, 1200 at 11, 21, 41, 81 vertices a side.
    Proportional to 1/h, this stiffens a cloth that is refined; it exists to reproduce their figures. It
    needs a mesh that has a size, so meshes from files are refused; the two other rules serve them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from harness.errors import InputError, Mistake, did_you_mean
from harness.mesh.base import BEND, SHEAR, STRETCH, Mesh

Scale = Callable[[Mesh, str, int | None], NDArray[np.float64] | float]
"""(mesh, family, reference) -> what a family's constant is multiplied by: one factor, or one a spring."""


def spring_stiffness(
    mesh: Mesh, *, rule: str, stretch: float, shear: float, bend: float, reference: int | None = None
) -> NDArray[np.float64]:
    """The stiffness of each spring, (m,) [N/m], from a constant for each family and one of `RULES`.

    Raises InputError for an unknown rule, a constant that is not finite or below zero, a rule that does not
    fit the mesh, and a `reference` that is missing (liu2013) or has no meaning (the others).
    """
    if rule not in RULES:
        raise InputError(Mistake(f"unknown rule {rule!r}; wanted {did_you_mean(rule, RULES)}", key="rule"))
    if reference is not None and rule != "liu2013":
        raise InputError(Mistake(f"has no meaning for the rule {rule}; leave it out", key="reference"))
    k = np.zeros(len(mesh.springs))
    for family, constant in ((STRETCH, stretch), (SHEAR, shear), (BEND, bend)):
        if not 0 <= constant < np.inf:
            raise InputError(Mistake(f"{constant} is no stiffness; wanted a finite number >= 0", key=family))
        k[mesh.families[family]] = constant * RULES[rule](mesh, family, reference)
    return k


def _fixed(mesh: Mesh, family: str, reference: int | None) -> float:
    return 1.0


def _continuum(mesh: Mesh, family: str, reference: int | None) -> NDArray[np.float64] | float:
    if family == BEND:
        return 16 / mesh.spacing**2
    if mesh.dimension > 1:
        return 1.0 if mesh.dimension == 2 else mesh.spacing
    lengths = mesh.rest_lengths[mesh.families[family]]
    if not lengths.all():
        problem = "continuum divides by rest lengths, and a spring joins two vertices in one place; use fixed"
        raise InputError(Mistake(problem, key="rule"))
    return 1 / lengths


def _liu2013(mesh: Mesh, family: str, reference: int | None) -> float:
    if reference is None or reference < 2:
        problem = f"came {reference}; liu2013 needs the mesh size, at least 2, at which the constants hold"
        raise InputError(Mistake(problem, key="reference"))
    if mesh.resolution < 2:
        problem = f"liu2013 needs a mesh that has a size of at least 2, this one has {mesh.resolution or 'none'}"
        raise InputError(Mistake(problem + "; use fixed or continuum", key="rule"))
    return (mesh.resolution - 1) / (reference - 1)


RULES: dict[str, Scale] = {"fixed": _fixed, "continuum": _continuum, "liu2013": _liu2013}
