"""Potential energies of the positions, one per file."""
