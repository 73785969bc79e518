"""External simulation engines as solvers, one per module."""
