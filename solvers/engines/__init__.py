"""Programs of others as solvers, each in a file of its own."""
