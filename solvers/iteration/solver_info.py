"""The metadata of a solver, given as its class variable `solver_info`, for tables and figures."""

from __future__ import annotations

from dataclasses import dataclass

LOCAL_GLOBAL_FAMILY = "local-global"
"""The family of the method of Liu et al. 2013, whose iterations are the unit for other methods."""

ENGINE_FAMILY = "engine"
"""The family of external programs."""


@dataclass(frozen=True, slots=True)
class Citation:
    """The publication of a method.

    Attributes:
        authors: names in BibTeX form, family names first, joined by `and`.
        year: year of publication.
        title: title of the publication.
        doi: identifier without the address of the registry; empty if there is none.

    Example:
        >>> authors = "Hestenes, Magnus R. and Stiefel, Eduard"
        >>> springbench.Citation(authors, 1952, "Methods of conjugate gradients for solving linear systems").year
        1952
    """

    authors: str
    year: int
    title: str
    doi: str = ""


@dataclass(frozen=True, slots=True)
class SolverInfo:
    """The metadata of a method for tables and figures.

    Attributes:
        family: methods of one family share a colour; those of LOCAL_GLOBAL_FAMILY perform the same iterations.
        citation: the publication of the method.
        is_substepping: whether the method integrates a frame in its own substeps, independent of the run's integrator.
        is_family_default: whether the method is the default of its family.
        supports_error_control: whether runs with an error target try the method. A substepping method then chooses its
            steps by their error (`with_tolerance`); other methods minimise the objective of an integrator with an error
            estimate.
        has_fixed_step: whether the substeps have a fixed size, which can be reduced (`with_refined_substeps`).
        package_name: the distribution that the method is an interface to, whose version is part of its rows.
        formula: the update of an iteration in one line, in the symbols of configs/explanation/notation.md.
        cost: the work of an iteration: solves with the factor of Q, passes over the springs, factorisations.

    Example:
        >>> springbench.SolverInfo("descent", formula="p' = p - t grad g(p)", cost="a pass over the springs").family
        'descent'
    """

    family: str
    citation: Citation | None = None
    is_substepping: bool = False
    is_family_default: bool = False
    supports_error_control: bool = False
    has_fixed_step: bool = False
    package_name: str = ""
    formula: str = ""
    cost: str = ""


LIU_2013 = Citation(
    "Liu, Tiantian and Bargteil, Adam W. and O'Brien, James F. and Kavan, Ladislav",
    2013,
    "Fast simulation of mass-spring systems",
    "10.1145/2508363.2508406",
)
