"""Numbers and words as text, in tables, pictures and messages."""

from __future__ import annotations


def format_count(number: int) -> str:
    """Format an integer with thin spaces between thousands."""
    return f"{number:,}".replace(",", "\u2009")


def format_quantity(value: float) -> str:
    """Format a number to three significant digits, with an exponent only from 1e7 on."""
    if value >= 1e7:
        return f"{value:.1e}"
    return f"{value:.3g}" if value < 1000 else format_count(round(value))


def format_factor(value: float) -> str:
    """Format a ratio to two significant digits, or to an integer from 100 on."""
    return f"{value:.2g}" if value < 100 else format_quantity(value)


def shorten_words(words: str, limit: int) -> str:
    """Shorten text to `limit` characters, with an ellipsis at the end."""
    return words if len(words) <= limit else words[: limit - 1].rstrip() + "…"


def format_time_step(dt: float) -> str:
    """Format a time step [s], such as 1/30 s.

    It is given in milliseconds if it is not the inverse of an integer.
    """
    whole = round(1 / dt)
    return f"1/{whole} s" if abs(whole * dt - 1) < 1e-9 else f"{1e3 * dt:.3g} ms"
