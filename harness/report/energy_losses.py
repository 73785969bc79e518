"""Sentences on the energy that a simulation dissipated."""

from __future__ import annotations

NOTABLE_SHARE = 0.01
"""Share of the provided energy above which dissipation is reported."""


def describe_losses(
    name: str, seconds: float, integrator: float, damping: float, friction: float, *, by_engine: bool = False
) -> str:
    """Describe the shares of the energy that an integrator, damping and friction dissipated.

    Args:
        name: name of the integrator or engine.
        seconds: simulated time [s].
        integrator, damping, friction: shares of the provided energy.
        by_engine: whether the integrator's share includes unconverged solves.

    Returns:
        A sentence without its full stop.
    """
    others = [(damping, "damping effects"), (friction, "friction")]
    effects = " and ".join(
        f"{what} {format_energy_share(share)}" for share, what in others if share >= NOTABLE_SHARE / 2
    )
    return (
        f"{name} {'took' if integrator > 0 else 'added'} {format_energy_share(integrator)} of the energy in "
        f"{seconds:.3g} s{' by its integrator and its solves' if by_engine else ''}{', ' if effects else ''}{effects}"
    )


def format_energy_share(share: float) -> str:
    """Return a share in percent."""
    return f"{100 * abs(share):.2g} %" if abs(share) < 1 else f"{100 * abs(share):.0f} %"
