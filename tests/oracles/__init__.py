"""Independent reference implementation of a scene's steps, written from the published formulas.

It shares no code with the solvers' energies and kernels. Both implementations share the mesh, the start, the reading of
files, and NumPy. Each module states one group of terms as the *values* of their elements. No module implements
gradients; these are computed by complex steps (see `complex_step`).
"""
