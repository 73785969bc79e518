"""Difference of two motions of one mesh, in mean rest lengths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.energy_balance import compute_kinetic_energy
from springbench.solvers.model.energies.spring_energy import Springs

MotionStates = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Positions [m] and velocities [m/s], (frames, n, 3) each."""


def compute_motion_difference(scene: Scene, a: MotionStates, b: MotionStates) -> dict[str, float]:
    """Return the columns that compare two motions.

    Args:
        scene: the full scene.
        a: first motion, whose largest energy is the unit of the energy difference.
        b: second motion.
    """
    (p, _), (q, _) = a, b
    unit, mass = compute_mean_rest_length(scene), scene.system.mass
    away = np.linalg.norm(p - q, axis=2)
    centres = np.einsum("i,fix->fx", mass, p - q) / mass.sum()
    energies = np.array(
        [[_compute_kinetic_and_spring_energy(scene, x, v) for x, v in zip(*motion, strict=True)] for motion in (a, b)]
    )
    most = float(np.abs(energies[0]).max())
    return {
        "displacement_max": float(away.max()) / unit,
        "displacement_rms": float(np.sqrt((away**2).mean())) / unit,
        "energy_difference": float(np.abs(energies[0] - energies[1]).max()) / most if most else 0.0,
        "centroid_displacement": float(np.linalg.norm(centres, axis=1).max()) / unit,
    }


def compute_mean_rest_length(scene: Scene) -> float:
    """Return the mean rest length of the scene's springs [m].

    It is the mesh spacing if there are no springs, or if all rest lengths are zero.
    """
    lengths = scene.all_springs.rest_length
    return float(lengths.mean()) if lengths.any() else scene.mesh.spacing


def _compute_kinetic_and_spring_energy(scene: Scene, p: NDArray[np.float64], v: NDArray[np.float64]) -> float:
    """Return the kinetic energy plus the energy of the full scene's springs [J].

    The same energies are evaluated for all motions.
    """
    elastic = sum(energy.value(p) for energy in scene.system.energies if isinstance(energy, Springs))
    return compute_kinetic_energy(scene.system.mass, v) + elastic
