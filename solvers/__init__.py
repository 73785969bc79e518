"""Implicit time stepping of mass-spring systems: numerics only, without files or clocks."""

from springbench.solvers.jit import source_digest  # noqa: F401  notes the state of all sources before any other is imported
