"""Configs: sweeps and accuracy configs, their validation, expansion and JSON Schema."""
