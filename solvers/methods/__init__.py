"""Methods that minimise a step's objective, or step without one: one a file."""
