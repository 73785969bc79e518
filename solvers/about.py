"""The metadata of a solver, given as its class variable `about`, for tables and figures."""

from __future__ import annotations

from dataclasses import dataclass

LOCAL_GLOBAL = "local-global"
"""The family of the method of Liu et al. 2013, whose iterations are the unit for other methods."""

ENGINE = "engine"
"""The family of external programs."""


@dataclass(frozen=True, slots=True)
class Reference:
    """The publication of a method.

    Attributes:
        authors: names in BibTeX form, family names first, joined by `and`.
        year: year of publication.
        title: title of the publication.
        doi: identifier without the address of the registry; empty if there is none.
    """

    authors: str
    year: int
    title: str
    doi: str = ""


@dataclass(frozen=True, slots=True)
class About:
    """The metadata of a method for tables and figures.

    Attributes:
        family: methods of one family share a colour; those of LOCAL_GLOBAL perform the same iterations.
        reference: the publication of the method.
        own_steps: whether the method integrates a frame in its own substeps, independent of the run's integrator.
        first: whether the method is the default of its family.
        to_error: whether runs with an error target try the method. A substepping method then chooses its
            steps by their error (`within`); other methods minimise the objective of an integrator with an error
            estimate.
        even: whether the substeps have a fixed size, which can be reduced (`refined`).
        package: the distribution that the method is an interface to, whose version is part of its rows.
    """

    family: str
    reference: Reference | None = None
    own_steps: bool = False
    first: bool = False
    to_error: bool = False
    even: bool = False
    package: str = ""


LIU_2013 = Reference(
    "Liu, Tiantian and Bargteil, Adam W. and O'Brien, James F. and Kavan, Ladislav",
    2013,
    "Fast simulation of mass-spring systems",
    "10.1145/2508363.2508406",
)
