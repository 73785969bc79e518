"""Explicit, linearly implicit and Rosenbrock time stepping."""
