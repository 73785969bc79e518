"""Solvers on a CUDA device, in Numba's CUDA target."""
