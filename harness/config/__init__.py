"""What a config says: sweeps and accuracy configs, expanded and checked, and their schema."""
