"""Compiled (Numba) inner loops."""
