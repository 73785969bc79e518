"""Compilation by Numba and its cache."""
