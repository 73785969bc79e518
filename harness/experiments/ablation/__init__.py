"""Ablation (`springbench ablate`): the cost and the influence of each effect.

It also suggests effects that a scene lacks.
"""
