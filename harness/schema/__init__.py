"""Configuration documents: YAML loader, base models, key paths for error messages."""
