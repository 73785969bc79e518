"""Figures for print: any panel or picture at a given width, with its data and a script that reproduces it."""
