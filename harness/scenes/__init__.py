"""Scenes: mesh, material, effects, initial state and motion, built for a mesh size."""
