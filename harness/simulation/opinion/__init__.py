"""A second opinion of a scene's steps: each formula written once more, from where it was published, sharing no code
with the solvers' energies and kernels.

What both opinions share is the mesh, the start, the reading of files, and NumPy. One file states one group of terms,
each as the *values* of its elements; nothing here knows a gradient, which complex steps take (see `derivatives`).
"""
