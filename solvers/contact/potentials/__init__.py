"""Barrier and friction potentials with derivatives."""
