"""Implicit time stepping of mass-spring systems: numerics only, no files, no clock."""

from solvers import sources  # noqa: F401  notes the state of all sources before any other is imported
