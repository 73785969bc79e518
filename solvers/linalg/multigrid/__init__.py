"""Smoothed-aggregation multigrid."""
