"""What accuracy costs in time: convergence curves on frozen steps, and the work of whole trajectories."""
