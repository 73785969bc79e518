"""Contact: broad phase, continuous collision detection, potentials and friction."""
