"""Figures for print: any panel or picture at a stated width, with its data and a script beside it."""
