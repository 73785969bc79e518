"""What a scene declares: mesh, material, effects, start and motion, bound to a mesh size."""
