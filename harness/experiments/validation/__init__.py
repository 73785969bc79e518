"""Validation: simulations compared with closed forms and with published measurements."""
