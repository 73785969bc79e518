"""Figures for print, with their data and a script that reproduces them."""
