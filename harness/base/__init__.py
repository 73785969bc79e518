"""Foundations of the harness: errors, YAML with line numbers, models, rows and machine facts."""
