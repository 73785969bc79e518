"""Grading (`springbench grade`, `springbench matrices`): positions and matrices of others, compared with a scene's."""
