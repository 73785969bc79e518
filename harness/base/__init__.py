"""What every part of the harness stands on: errors, YAML with lines, models, rows, the machine."""
