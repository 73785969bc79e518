"""Figures for print, with their data and a script that reproduces them.

Any panel or picture can be drawn at a given width.
"""
