"""The rows of `springbench accuracy`: their content, and what follows from them."""
