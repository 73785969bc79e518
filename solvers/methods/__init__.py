"""Methods that minimise the objective of a step, or integrate it without an objective."""
