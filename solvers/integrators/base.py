"""What time integrators of more than one unknown a step share: they state one after the other, and are told of each.

An unknown x minimises energies(x) + c/(2 dt^2) |x - target|_M^2 - tr(x' f), as that of implicit Euler does, with the
same c for all: Q is factorised once, and every minimiser serves. At the minimum M c/dt^2 (x - target) is the force, so

    acceleration = c/dt^2 (x - target),     velocity = rate (x - origin)

and no force is evaluated besides.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import NamedTuple

from solvers.problem import Positions


class Motion(NamedTuple):
    """positions (n, 3) [m] and velocity (n, 3) [m/s] at one time."""

    positions: Positions
    velocity: Positions


class Unknown(NamedTuple):
    """when: the time of x within the step, 1 at its end; target and origin (n, 3) [m], which whoever asks may write to;
    acceleration: what the motion so far leads to expect at x, (n, 3) [m/s^2], None where nothing does."""

    when: float
    target: Positions
    origin: Positions
    acceleration: Positions | None


class Solved(NamedTuple):
    """positions [m], velocity [m/s] and acceleration [m/s^2] of an unknown, each (n, 3)."""

    positions: Positions
    velocity: Positions
    acceleration: Positions


class End(NamedTuple):
    """motion and acceleration (n, 3) [m/s^2] at the step's end; error: of the motion, by an embedded method of lower
    order, None without one."""

    motion: Motion
    acceleration: Positions
    error: Motion | None = None


Unknowns = Generator[Unknown, Solved, End]
"""Yields the unknowns of a step, each after it was sent the solution of the one before."""
