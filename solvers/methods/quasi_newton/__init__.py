"""Accelerated first-order and quasi-Newton methods."""
