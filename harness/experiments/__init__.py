"""What is run and kept: sweeps, accuracy, speed, ablation, galleries."""
