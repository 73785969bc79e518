"""Meshes: generators with one number for the size, and files."""
