"""Potentials of the positions, one a file."""
