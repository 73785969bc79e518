"""What the rows of `springbench speed` say: figures, a table, and pictures against size."""
