"""Unilateral penalty contact of vertices with half-spaces."""
