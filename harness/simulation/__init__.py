"""Simulation of one run: time stepping, its timing, and the instrumentation pass."""
