"""Distances of primitives and axis-aligned bounding boxes."""
