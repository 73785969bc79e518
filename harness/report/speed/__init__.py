"""Reports on the rows of `springbench roofline`: figures and a table."""
