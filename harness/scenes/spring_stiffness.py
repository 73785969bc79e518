"""Spring stiffness [N/m] from material constants and a scaling rule with the mesh size.

fixed        The constants are the stiffness of each spring [N/m], independent of the mesh.

continuum    The material is independent of mesh refinement. With h the spacing:
    dimension 1   k_e = EA / rest length; constants EA [N]. Springs in series add up to EA / L.
    dimension 2   k_e constant; constants [N/m]. There are 1/h springs across a metre of width, so that the
                  force per width and strain is k / h * h = k. With both diagonals, of constant s:
                  C11 = k + s, C12 = C66 = s [N/m].
    dimension 3   k_e = E h; constants [Pa]. There are 1/h^2 springs across a square metre, so that the
                  force per area and strain is k h / h^2 = E. With the diagonals of a block, of constant S:
                  C11 = E + 10/3 S, C12 = C66 = 7/3 S [Pa].
    These are limits for h -> 0. Springs on the boundary have cells on one side only but full stiffness, so a cloth of
    width W is stiffer by up to h / W, and a block by up to that for each side of its cross-section.
    bending       k_e = 16 B / h^2, constant B [N m] (BEND springs, rest length 2h, in dimension 2), and
                  4 k_e less for the springs along the lines (STRETCH), 2 k_e less at the ends of lines.

    Skip-one springs have no quadratic bending energy about a flat sheet: a fold by the angle t shortens one
    by 2h (1 - cos(t/2)), h t^2/4 to leading order. A metre of fold has 1/h of them, which store
    k h t^4/32. A sheet of bending stiffness B with the same fold over one spacing stores
    B (t/h)^2 h/2 = B t^2/(2h). The two agree at t = 1 rad for k = 16 B / h^2: the sharpest bends of the mesh
    have the resistance of the sheet. Smaller angles are underestimated by the factor t^2. A fixed curvature c implies
    t = c h, so smooth bends get softer under refinement, and the limit is the membrane without B.
    Skip-one springs resist stretch too. Along a line each spring is covered by two of them (by one at the
    ends). Each adds 2h k per unit of strain, as much as an increase of the spring's own stiffness by 2 k. The spring's
    stiffness is reduced accordingly, so the membrane stiffness of the sheet is `stretch` at every size. A mesh with
    h < 8 sqrt(B / stretch) would leave no stiffness and is rejected. This rule is original to this project.

area         As continuum in dimension 1. On surfaces and solids of files each spring has a stiffness by the area or
    volume around it, so that a uniform stretch of any triangulation needs the force of the stated membrane stiffness
    [N/m] or modulus [Pa]; formula and limits: `springbench.harness.scenes.membrane_modulus`.

liu2013      k_e = constant * (resolution - 1) / (reference - 1), constants [N/m] as given for the size
    `reference_size`: Liu et al. 2013 use 150, 300, 600, 1200 for their curtain at 11, 21, 41, 81 vertices per side.
    Proportional to 1/h, the rule stiffens a cloth under refinement; it exists to reproduce their figures. It
    requires a mesh size and does not support meshes from files; the other rules do.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.harness.errors import InputError, InputMistake, format_allowed_names
from springbench.harness.scenes.membrane_modulus import compute_area_stiffness
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh
from springbench.harness.scenes.orthotropic_cloth import OrthotropicStiffness

ScalingRule = Callable[[Mesh, str, int | None], NDArray[np.float64] | float]
"""(mesh, family, reference size) -> factor of a family's constant: one for all springs, or one per spring."""


def compute_spring_stiffness(
    mesh: Mesh,
    *,
    scaling_rule: str,
    stretch: float | OrthotropicStiffness,
    shear: float | OrthotropicStiffness,
    bend: float,
    reference_size: int | None = None,
) -> NDArray[np.float64]:
    """Compute the stiffness of each spring, (m,) [N/m].

    Args:
        mesh: the mesh.
        scaling_rule: one of `SCALING_RULES`.
        stretch, shear: constants of the families, or constants by direction; infinite for length constraints.
        bend: constant of the skip-one springs.
        reference_size: mesh size of the constants, for liu2013 only.

    Raises:
        InputError: for an unknown rule, for a constant that is negative or not finite (except as above), for a rule
            that does not fit the mesh, and for a reference size that is missing or unused.
    """
    if scaling_rule not in SCALING_RULES:
        raise InputError(
            InputMistake(
                f"unknown rule {scaling_rule!r}; expected {format_allowed_names(scaling_rule, SCALING_RULES)}",
                key="scaling_rule",
            )
        )
    if reference_size is not None and scaling_rule != "liu2013":
        raise InputError(
            InputMistake(f"has no meaning for the rule {scaling_rule}; leave it out", key="reference_size")
        )
    k = np.zeros(len(mesh.springs))
    for family, constant in ((STRETCH, stretch), (SHEAR, shear), (BEND, bend)):
        of = mesh.spring_families[family]
        if isinstance(constant, OrthotropicStiffness):
            k[of] = constant.compute_stiffness(mesh, mesh.springs[of]) * SCALING_RULES[scaling_rule](
                mesh, family, reference_size
            )
            continue
        if not 0 <= constant < np.inf and (family == BEND or constant != np.inf):
            raise InputError(InputMistake(f"{constant} is no stiffness; expected a finite number >= 0", key=family))
        k[of] = constant * SCALING_RULES[scaling_rule](mesh, family, reference_size)
    return _subtract_bend_stiffness(mesh, k) if scaling_rule == "continuum" else k


def _subtract_bend_stiffness(mesh: Mesh, k: NDArray[np.float64]) -> NDArray[np.float64]:
    """Subtract the stretch stiffness of skip-one springs from the springs along the lines."""
    if not k[mesh.spring_families[BEND]].any():
        return k
    along = mesh.spring_families[STRETCH]
    added = 2 * _count_overlapping_bends(mesh) * k[mesh.spring_families[BEND]].max()
    if (added > k[along]).any():
        worst = int(np.argmax(added - k[along]))
        had, more = k[along][worst], added[worst]
        least = mesh.spacing * (more / had) ** 0.5 if had else np.inf
        problem = (
            f"its springs alone would resist stretch by {more:.4g} N/m at a spacing of {mesh.spacing:.4g} m, and "
            f"`stretch` is {had:.4g} N/m; expected a spacing of at least {least:.4g} m, less `bend` or more `stretch`"
        )
        raise InputError(InputMistake(problem, key="bend"))
    k[along] -= added
    return k


def _count_overlapping_bends(mesh: Mesh) -> NDArray[np.int64]:
    """Count the BEND springs that cover each STRETCH spring, one or two.

    A BEND spring spans two STRETCH springs.
    """
    # A sparse matrix with the number of the STRETCH spring, from 1, at both orders of its vertices. The product of the
    # rows of the two ends of a BEND spring is nonzero at the vertex between them.
    (i, j), (a, b) = (mesh.springs[mesh.spring_families[family]].T for family in (STRETCH, BEND))
    n, name = len(mesh.rest_positions), np.arange(1, len(i) + 1)
    spring = scipy.sparse.coo_array((np.tile(name, 2), (np.r_[i, j], np.r_[j, i])), shape=(n, n)).tocsr()
    bend, middle = cast(scipy.sparse.csr_array, spring[a] * spring[b]).nonzero()
    under = [np.asarray(spring[end[bend], middle]) for end in (a, b)]
    return np.bincount(np.concatenate(under) - 1, minlength=len(i))


def _fixed_scale(mesh: Mesh, family: str, reference: int | None) -> float:
    return 1.0


def _continuum_scale(mesh: Mesh, family: str, reference: int | None) -> NDArray[np.float64] | float:
    if family == BEND:
        return 16 / mesh.spacing**2
    if mesh.dimension > 1:
        return 1.0 if mesh.dimension == 2 else mesh.spacing
    of, own = mesh.spring_families[family], mesh.spring_properties
    lengths = mesh.rest_lengths[of]
    needed = np.ones(len(of), np.bool_) if own is None else np.isnan(own.stiffness[of])
    if not lengths[needed].all():
        problem = "continuum divides by rest lengths, and a spring joins two vertices in one place; use fixed"
        raise InputError(InputMistake(problem, key="scaling_rule"))
    return np.divide(1.0, lengths, out=np.zeros_like(lengths), where=needed)


def _area_scale(mesh: Mesh, family: str, reference: int | None) -> NDArray[np.float64] | float:
    if mesh.dimension == 1 or family == BEND:
        return _continuum_scale(mesh, family, reference)
    return compute_area_stiffness(mesh)[mesh.spring_families[family]]


def _liu2013_scale(mesh: Mesh, family: str, reference: int | None) -> float:
    if reference is None or reference < 2:
        problem = f"got {reference}; liu2013 needs the mesh size, at least 2, at which the constants are valid"
        raise InputError(InputMistake(problem, key="reference_size"))
    if mesh.resolution < 2:
        problem = f"liu2013 needs a mesh that has a size of at least 2, this one has {mesh.resolution or 'none'}"
        raise InputError(InputMistake(problem + "; use fixed or continuum", key="scaling_rule"))
    return (mesh.resolution - 1) / (reference - 1)


def compute_modulus_exponent(scaling_rule: str, dimension: int) -> int:
    """Return the exponent of the spacing h in the material modulus of a mesh.

    The modulus is EA of a chain (k h), E t of a sheet (k) and E of a solid (k / h), for springs of stiffness k along
    its lines. With `continuum` and `area` it does not depend on h.

    Args:
        scaling_rule: a key of SCALING_RULES.
        dimension: 1 for a chain, 2 for a sheet, 3 for a solid.
    """
    return {"continuum": 0, "area": 0, "fixed": 2 - dimension, "liu2013": 1 - dimension}[scaling_rule]


SCALING_RULES: dict[str, ScalingRule] = {
    "fixed": _fixed_scale,
    "continuum": _continuum_scale,
    "area": _area_scale,
    "liu2013": _liu2013_scale,
}
