"""Linear solvers for symmetric positive definite systems: factorisations, conjugate gradients and preconditioners."""
