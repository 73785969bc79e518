"""The step problem: system, constraints, assembly, energies, integrators."""
