"""Effects of a scene, one per module; `effect_table.py` has the table of their names."""
