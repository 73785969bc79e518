"""Discovery and import of solvers and effects of others."""
