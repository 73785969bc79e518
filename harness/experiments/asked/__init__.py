"""Any error that is asked for: ways to keep to it, their choice, and what is told of it."""
