"""Methods that minimise the objective of a step, or that integrate a step without an objective."""
