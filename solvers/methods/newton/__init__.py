"""Newton's method, Newton-CG and the hybrid of both with local-global iterations."""
