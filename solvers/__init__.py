"""Implicit time stepping of mass-spring systems: numerics only, no files, no clock."""
