"""Ablation (`springbench ablate`): what each effect of a scene costs and changes, and which effects it lacks."""
