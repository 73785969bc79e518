"""Implicit time stepping of mass-spring systems: numerics only, without files or clocks."""

from solvers import sources  # noqa: F401  notes the state of all sources before any other is imported
