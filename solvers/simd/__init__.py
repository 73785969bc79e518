"""Kernels written explicitly for SIMD registers, where compilers do not vectorise by themselves."""
