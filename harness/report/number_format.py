"""Numbers and words as text, in tables, pictures and messages."""

from __future__ import annotations

from math import floor, log10

_SUPERSCRIPT_TABLE = str.maketrans("-0123456789.", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹·")


def format_count(number: int) -> str:
    """Format an integer with thin spaces between thousands."""
    return f"{number:,}".replace(",", "\u2009")


def format_quantity(value: float) -> str:
    """Format a number to three significant digits, or to an integer from 1000 on.

    It has an exponent below 1e-4 and from 1e7 on.
    """
    if value >= 1e7:
        return f"{value:.1e}"
    return f"{value:.3g}" if value < 1000 else format_count(round(value))


def format_factor(value: float) -> str:
    """Format a ratio to two significant digits, or to an integer from 100 on."""
    return f"{value:.2g}" if value < 100 else format_quantity(value)


def format_power(value: float) -> str:
    """Format a power of ten, or a plain number between 0.01 and 1000.

    The exponent is in superscript characters of the full font size; math text would use 0.7 of it.
    """
    if 0.01 < value < 1000.0:
        return f"{value:g}"
    exponent = floor(log10(value) + 1e-9)
    mantissa = value / 10.0**exponent
    front = "" if abs(mantissa - 1.0) < 1e-6 else f"{mantissa:g}·"
    return f"{front}10{str(exponent).translate(_SUPERSCRIPT_TABLE)}"


def shorten_words(words: str, limit: int) -> str:
    """Shorten text, with an ellipsis at the end.

    Args:
        words: text, unchanged if it is short enough.
        limit: largest number of characters, the ellipsis included.
    """
    return words if len(words) <= limit else words[: limit - 1].rstrip() + "…"


def format_time_step(dt: float) -> str:
    """Format a time step [s], such as 1/30 s.

    It is given in milliseconds if it is not the inverse of an integer.
    """
    whole = round(1 / dt)
    return f"1/{whole} s" if abs(whole * dt - 1) < 1e-9 else f"{1e3 * dt:.3g} ms"
