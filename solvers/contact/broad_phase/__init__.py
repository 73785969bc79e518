"""Candidate pairs: bounding volume hierarchy, cluster culling, candidate cache."""
