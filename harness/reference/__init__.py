"""Reference solutions for accuracy measurements: step snapshots, certified minima, trajectories of the ODE."""
