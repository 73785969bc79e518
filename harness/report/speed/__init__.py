"""Reports on the rows of `springbench speed`: figures, a table, and plots against size."""
