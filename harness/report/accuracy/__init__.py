"""The rows of `springbench accuracy`: what they hold, and what follows from them."""
