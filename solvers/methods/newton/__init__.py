"""Newton's method, Newton-CG, and the hybrid of L-BFGS and Newton's method."""
