"""Energy, momentum, strain and intersections of positions over time.

    E_t = 1/2 |(p^t - p^(t-dt))/dt|_M^2 + sum of potentials(p^t) - f . (p^t - p^0)
    momentum error = |M (v^t - v^(t-dt)) - dt sum f| / (sum of |m v| + |dt f|)

Implicit Euler conserves the linear momentum of a scene without pins up to its forces.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.experiments.grading.submission import SubmittedMotion
from springbench.harness.reference.self_converged_trajectory import has_contact
from springbench.harness.scenes.edge_triangle_intersections import find_edge_triangle_intersections
from springbench.harness.scenes.mesh.mesh_checks import build_edge_table
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.spring_strains import compute_strains
from springbench.harness.simulation.energy_balance import compute_kinetic_energy
from springbench.solvers.model.step_problem import is_lagged

MAX_CHECKED_FRAMES = 6
"""Number of frames in which intersections are counted."""


class MotionQuantities(NamedTuple):
    """Quantities after each step.

    Arrays are (k,); those of energies and strains are (k + 1,), with the start first.

    Attributes:
        energy: kinetic and potential energy less the work of constant forces [J].
        kinetic_energy: [J].
        max_strain: largest magnitude of a spring's strain.
        momentum_error: relative violation of the balance of momentum; None with pins or obstacles, which take momentum.
        intersections: numbers of intersections of edges with triangles by step; empty without surfaces.
    """

    energy: NDArray[np.float64]
    kinetic_energy: NDArray[np.float64]
    max_strain: NDArray[np.float64]
    momentum_error: NDArray[np.float64] | None
    intersections: dict[int, int]


def measure_motion(scene: Scene, submission: SubmittedMotion) -> MotionQuantities:
    """Measure the quantities of a submission.

    Args:
        scene: scene with the time step of the submission.
        submission: positions to measure, whose stored digits bound the round-off.
    """
    p, system, springs = submission.positions, scene.system, scene.all_springs
    start = p[1]
    _, vertices, weight = system.penalty_pins
    soft = system.penalty_pins[0]
    mass = np.where(system.unpinned_mask, system.mass, 0.0)
    kinetic, energy, strain = list[float](), list[float](), list[float]()
    with np.errstate(all="ignore"):
        velocities = np.diff(p, axis=0) / system.time_step
        for step, q in enumerate(p[1:]):
            kinetic.append(compute_kinetic_energy(mass, velocities[step]))
            away = q[vertices] - scene.compute_pin_targets(scene.compute_time(step))[soft]
            near = np.abs(away) <= 4.0 * submission.precision.bound_error(
                q
            )  # round-off of the file, which heavy pins amplify
            away = np.where(near, 0.0, away)
            potential = sum(one.value(q) for one in system.energies if not is_lagged(one))
            potential += 0.5 * float(weight @ np.einsum("ij,ij->i", away, away))
            free = system.unpinned_mask
            work = float(np.einsum("ij,ij->", scene.constant_force[free], (q - start)[free]))
            energy.append(kinetic[-1] + float(potential) - work)
            strains = compute_strains(q, springs.edges, springs.rest_length)[0]
            strain.append(float(np.abs(strains).max(initial=0.0)))
        momentum = _measure_momentum(scene, velocities) if not len(system.pins.vertices) else None
    return MotionQuantities(
        np.array(energy), np.array(kinetic), np.array(strain), momentum, _count_intersections(scene, submission)
    )


def _measure_momentum(scene: Scene, velocities: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Measure the violation of the balance of linear momentum.

    The result is None with forces that change, velocity filters or contact.
    """
    if scene.varying_forces or scene.velocity_filters or has_contact(scene.system):
        return None
    mass, dt = scene.system.mass, scene.system.time_step
    momentum = np.einsum("i,tij->tj", mass, velocities)
    impulse = dt * scene.constant_force.sum(axis=0)
    size = np.einsum("i,tij->t", mass, np.abs(velocities))[1:] + float(np.abs(dt * scene.constant_force).sum())
    away = np.linalg.norm(np.diff(momentum, axis=0) - impulse, axis=1)
    return np.divide(away, size, out=np.zeros_like(away), where=size > 0.0)


def _count_intersections(scene: Scene, submission: SubmittedMotion) -> dict[int, int]:
    """Count intersections in some frames.

    These are those that an effect prevents, or else those of the mesh with itself.
    """
    triangles, steps = scene.mesh.triangles, submission.num_steps
    if not scene.intersection_checks and not len(triangles):
        return {}
    edges = build_edge_table(triangles).edges
    chosen = sorted({round(x) for x in np.linspace(1, steps, MAX_CHECKED_FRAMES)} & set(range(1, steps + 1)))
    counts = dict[int, int]()
    for step in chosen:
        p = submission.position_after(step)
        if scene.intersection_checks:
            time = scene.compute_time(step)
            counts[step] = sum(len(check.find_intersections(p, time)) for check in scene.intersection_checks)
        else:
            counts[step] = len(find_edge_triangle_intersections(p, edges, triangles))
    return counts
