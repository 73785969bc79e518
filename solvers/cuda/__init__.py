"""Methods on a CUDA device, in Numba's own target; one a file, beside what they share."""
