"""Vertex block descent and its variants: method, kernels, contact."""
