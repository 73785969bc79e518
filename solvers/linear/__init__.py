"""Factorisations of the constant matrix Q, one a file."""
