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
    bending       k_e = 16 B / h^2, constant B [N m] (BEND springs, rest length 2h, in dimension 2), and
                  4 k_e less for the springs along the lines (STRETCH), 2 k_e less at the ends of lines.

    Skip-one springs have no quadratic bending energy about a flat sheet: a fold by the angle t shortens one
    by 2h (1 - cos(t/2)), h t^2/4 to leading order, and a metre of fold has 1/h of them, which store
    k h t^4/32. A sheet of bending stiffness B that takes the same fold over one spacing stores
    B (t/h)^2 h/2 = B t^2/(2h). The two agree at t = 1 rad for k = 16 B / h^2: the sharpest bends of the mesh
    resist as the sheet does. Gentler ones are underestimated by the factor t^2; a fixed curvature c makes
    t = c h, so smooth bends get softer as the mesh is refined, and the limit is the membrane without B.
    Skip-one springs resist stretch too. Along a line each spring lies under two of them (under one at the
    ends), each of which pulls with 2h k at a unit of strain, as much as 2 k more in the spring below would. That
    has so much less, so that the sheet's membrane stiffness is `stretch` at every size. A mesh so fine that
    nothing would be left, h < 8 sqrt(B / stretch), is refused. This rule is our own.

liu2013      k_e = constant * (resolution - 1) / (reference - 1), constants [N/m] as they are at the size
    `reference`: Liu et al. 2013 give their curtain 150, 300, 600, 1200 at 11, 21, 41, 81 vertices a side.
    Proportional to 1/h, this stiffens a cloth that is refined; it exists to reproduce their figures. It
    needs a mesh that has a size, so meshes from files are refused; the two other rules serve them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import scipy
from numpy.typing import NDArray

from harness.base.errors import InputError, Mistake, did_you_mean
from harness.scenes.mesh.base import BEND, SHEAR, STRETCH, Mesh
from harness.scenes.weave import Weave

Scale = Callable[[Mesh, str, int | None], NDArray[np.float64] | float]
"""(mesh, family, reference) -> what a family's constant is multiplied by: one factor, or one a spring."""


def spring_stiffness(
    mesh: Mesh,
    *,
    rule: str,
    stretch: float | Weave,
    shear: float | Weave,
    bend: float,
    reference: int | None = None,
) -> NDArray[np.float64]:
    """The stiffness of each spring, (m,) [N/m], from a constant for each family, or by its direction, and one of
    `RULES`.

    A constant of stretch or shear may be infinite: those springs are exact. Raises InputError for an unknown rule, any
    other constant that is not finite, one below zero, a rule that does not fit the mesh, and a `reference` that is
    missing (liu2013) or has no meaning (the others).
    """
    if rule not in RULES:
        raise InputError(Mistake(f"unknown rule {rule!r}; wanted {did_you_mean(rule, RULES)}", key="rule"))
    if reference is not None and rule != "liu2013":
        raise InputError(Mistake(f"has no meaning for the rule {rule}; leave it out", key="reference"))
    k = np.zeros(len(mesh.springs))
    for family, constant in ((STRETCH, stretch), (SHEAR, shear), (BEND, bend)):
        of = mesh.families[family]
        if isinstance(constant, Weave):
            k[of] = constant.of(mesh, mesh.springs[of]) * RULES[rule](mesh, family, reference)
            continue
        if not 0 <= constant < np.inf and (family == BEND or constant != np.inf):
            raise InputError(Mistake(f"{constant} is no stiffness; wanted a finite number >= 0", key=family))
        k[of] = constant * RULES[rule](mesh, family, reference)
    return _relieved(mesh, k) if rule == "continuum" else k


def _relieved(mesh: Mesh, k: NDArray[np.float64]) -> NDArray[np.float64]:
    """The stiffnesses, those along the lines less what skip-one springs add to them."""
    if not k[mesh.families[BEND]].any():
        return k
    along = mesh.families[STRETCH]
    added = 2 * _overlaps(mesh) * k[mesh.families[BEND]].max()
    if (added > k[along]).any():
        worst = int(np.argmax(added - k[along]))
        had, more = k[along][worst], added[worst]
        least = mesh.spacing * (more / had) ** 0.5 if had else np.inf
        problem = (
            f"its springs alone would resist stretch by {more:.4g} N/m at a spacing of {mesh.spacing:.4g} m, and "
            f"`stretch` is {had:.4g} N/m; wanted a spacing of at least {least:.4g} m, less `bend` or more `stretch`"
        )
        raise InputError(Mistake(problem, key="bend"))
    k[along] -= added
    return k


def _overlaps(mesh: Mesh) -> NDArray[np.int64]:
    """Under how many BEND springs each STRETCH spring lies: one or two. A BEND spring spans two of them."""
    (i, j), (a, b) = (mesh.springs[mesh.families[family]].T for family in (STRETCH, BEND))
    n, name = len(mesh.rest), np.arange(1, len(i) + 1)
    spring = scipy.sparse.coo_array((np.tile(name, 2), (np.r_[i, j], np.r_[j, i])), shape=(n, n)).tocsr()
    bend, middle = cast(scipy.sparse.csr_array, spring[a] * spring[b]).nonzero()
    under = [np.asarray(spring[end[bend], middle]) for end in (a, b)]
    return np.bincount(np.concatenate(under) - 1, minlength=len(i))


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


def modulus_exponent(rule: str, dimension: int) -> int:
    """Return the power of the spacing h that the modulus of a mesh's material is proportional to.

    The modulus is EA of a chain (k h), E t of a sheet (k) and E of a solid (k / h), of springs of stiffness k along
    its lines. With `continuum` it does not depend on h.
    """
    return {"continuum": 0, "fixed": 2 - dimension, "liu2013": 1 - dimension}[rule]


RULES: dict[str, Scale] = {"fixed": _fixed, "continuum": _continuum, "liu2013": _liu2013}
