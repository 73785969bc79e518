"""The truth that accuracy is graded against: frozen step problems, certified minima, trajectories of the ODE."""
