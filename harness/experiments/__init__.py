"""Experiments and their stored results: sweeps, accuracy, speed, ablation, galleries."""
