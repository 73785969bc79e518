"""Reports on the rows of `springbench roofline`: figures, a table, and plots against size."""
