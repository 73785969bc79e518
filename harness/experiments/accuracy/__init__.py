"""Accuracy against time: convergence curves on step snapshots, and work-precision of whole simulations."""
