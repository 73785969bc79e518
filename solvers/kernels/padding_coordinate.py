"""The coordinate of padding rows."""

from __future__ import annotations

PADDING_COORDINATE = 1e100
"""Coordinate [m] of the ends of padding springs, far from any vertex in any unit of length."""
