"""What a scene can contain, one effect a file; the table of their names is in `effect_names.py`."""
