"""What a solver may tell of itself, as a class variable `about`, for tables and pictures."""

from __future__ import annotations

from dataclasses import dataclass

LOCAL_GLOBAL = "local-global"
"""The family of the method of Liu et al. 2013, by whose iterations others are measured."""

ENGINE = "engine"
"""The family of other people's programs."""


@dataclass(frozen=True, slots=True)
class Reference:
    """Where a method comes from. authors: as BibTeX has them, family names first, joined by `and`; doi: without the
    address of its registry, empty where there is none."""

    authors: str
    year: int
    title: str
    doi: str = ""


@dataclass(frozen=True, slots=True)
class About:
    """What tables and pictures tell of a method.

    family: methods of one family share a colour; those of LOCAL_GLOBAL do the same iterations. own_steps: whether it
    integrates a frame in substeps of its own, whatever the integrator of the run. first: whether it is the one of its
    family to take first. to_error: whether it is tried where an error is asked for: one with steps of its own chooses
    them by their error (`within`), others minimise what an integrator with an error states. even: whether its own steps
    have one length instead, and can be had shorter (`refined`). package: the distribution that it is an interface to,
    whose version its rows tell.
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
