"""Sparse Cholesky factorisation: ordering, symbolic and numeric phase, triangular solves."""
