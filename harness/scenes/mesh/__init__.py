"""Meshes: generators with a single size parameter, and files."""
