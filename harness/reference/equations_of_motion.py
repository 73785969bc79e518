"""Equations of motion as a first-order system y' = F(t, y) of the free vertices.

    M p'' = f(p, p', t) - grad E(p) - c M p'

The state y is the positions and velocities. Springs are summed by a compiled loop. An energy that depends on the start
of a step is initialised with the motion itself, so that its gradient at p is the force there. Ether drag is defined by
its effect on the velocity in a step, v <- a v, and so has the rate c = -ln(a) / dt. No other velocity filter has an
equation of motion.
"""

from __future__ import annotations

from functools import reduce
from math import log

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import RunFailed
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import build_initial_state
from springbench.solvers.contact.half_space.vertex_contact import without_vertex_contact
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.energies.spring_energy import ZERO_LENGTH, Springs
from springbench.solvers.model.step_problem import Positions, StepStart, is_lagged

RealArray = NDArray[np.float64]
OdeState = RealArray
"""Positions [m] and velocities [m/s] of the free vertices, concatenated, shape (6 f,)."""

FINITE_DIFFERENCE_SECONDS = 1e-5
"""Interval [s] of the finite difference for the velocity of moving pins, which only damping uses. It is accurate to ten
digits, but rounds a corner of their path."""


class NotIntegrable(RunFailed):
    """The scene has no ordinary differential equation for all of its free vertices."""


class OdeField:
    """F of a scene whose pins are exact."""

    def __init__(self, scene: Scene, *, compiled: bool = True) -> None:
        """Check that the scene has equations of motion.

        Args:
            scene: scene with exact pins.
            compiled: whether springs are summed by the compiled loop instead of NumPy.

        Raises:
            NotIntegrable: the scene has no equations of motion.
        """
        system = scene.system
        self._scene, self._free, self._system = scene, system.free_vertices, system
        self._mass = system.mass[self._free, None]
        if not (self._mass > 0.0).all():
            raise NotIntegrable("vertices without mass have no acceleration; give them mass or pin them")
        if not system.pins.exact_mask.all():
            raise NotIntegrable("pins by penalty vibrate faster than can be followed; make them exact")
        if system.length_constraints:
            raise NotIntegrable("lengths that are exact make it no differential equation; give them a stiffness")
        if without_barriers(without_vertex_contact(system)) is not system:
            raise NotIntegrable("contact is stiff, and its friction restarts in each step; leave it out")
        x = Springs.from_parts([energy for energy in system.energies if isinstance(energy, Springs)])
        arrays = x.edges, x.stiffness, x.rest_length, x.rest_direction
        self._springs = arrays if compiled else None
        self._others = tuple(energy for energy in system.energies if not (compiled and isinstance(energy, Springs)))
        self._drag = _measure_drag(scene)
        self._p, self._v = scene.mesh.rest_positions.copy(), np.zeros_like(scene.mesh.rest_positions)
        self._p[system.pins.vertices] = scene.compute_pin_targets(0.0)

    @property
    def initial_state(self) -> OdeState:
        """The initial state of the scene (6 f,)."""
        return np.concatenate([part[self._free].ravel() for part in build_initial_state(self._scene).motion])

    def unpack_state(self, t: float, y: OdeState) -> tuple[Positions, Positions]:
        """Return positions [m] and velocities [m/s] of all vertices, overwritten by the next call.

        Args:
            t: time [s], at which moving pins are placed.
            y: state (6 f,) of the f free vertices.

        Returns:
            Positions (n, 3) and velocities (n, 3); those of pinned vertices follow from the motion of the pins.
        """
        self._p[self._free], self._v[self._free] = y.reshape(2, -1, 3)
        if self._scene.pin_motions:
            pinned, h = self._system.pins.vertices, FINITE_DIFFERENCE_SECONDS
            self._p[pinned] = self._scene.compute_pin_targets(t)
            self._v[pinned] = (self._scene.compute_pin_targets(t + h) - self._scene.compute_pin_targets(t - h)) / (
                2.0 * h
            )
        return self._p, self._v

    def __call__(self, t: float, y: OdeState) -> OdeState:
        """Evaluate F(t, y).

        Args:
            t: time [s].
            y: state (6 f,): positions [m], then velocities [m/s] of the f free vertices.

        Returns:
            dy/dt (6 f,): velocities [m/s], then accelerations [m/s^2].
        """
        p, v = self.unpack_state(t, y)
        push = np.negative(self._scene.constant_force)
        if self._springs:
            add_springs(p, *self._springs, push)
        if self._others:
            rate = self._system.velocity_rate
            here = StepStart(p, v, t, p - v / rate, rate, t)
            for energy in self._others:
                (energy.begin_step(here) if is_lagged(energy) else energy).add_gradient(p, push)
        for force in self._scene.varying_forces:
            push -= force(p, v, t)
        out = np.empty_like(y).reshape(2, -1, 3)
        out[0] = v[self._free]
        out[1] = -push[self._free] / self._mass - self._drag * out[0]
        return out.reshape(-1)

    def evaluate_fingerprint(self) -> OdeState:
        """Evaluate F at a strained and moving state, as a fingerprint of the equations."""
        y = self.initial_state
        return self(
            0.5,
            y + 0.01 * (self._scene.mesh.bounding_box_diagonal or 1.0) * np.random.default_rng(1).normal(size=y.shape),
        )


def build_ode_scene(spec: SceneSpec, size: int) -> Scene:
    """Build a scene with equations of motion.

    Velocity filters without an equation of motion are converted to forces.

    Args:
        spec: specification of the scene.
        size: size of the scene.

    Returns:
        The scene, with all of its pins exact.

    Raises:
        InputError: the scene cannot be built.
        NotIntegrable: the scene has no equations of motion.
    """
    scene = build_exact_scene(spec, size)
    try:
        OdeField(scene)
    except NotIntegrable:
        if not scene.velocity_filters:
            raise
        scene = build_exact_scene(spec, size, "substepping")
        OdeField(scene)
    return scene


@jit_kernel
def add_springs(
    p: Positions,
    edges: NDArray[np.int64],
    stiffness: RealArray,
    rest_length: RealArray,
    direction: RealArray,
    out: Positions,
) -> None:
    """Add the springs' gradient [N] to `out` (n, 3).

    The gradient is k (1 - r/l) (p_i - p_j) at p (n, 3) [m].

    Args:
        p: positions (n, 3) [m].
        edges: vertex pairs (m, 2).
        stiffness: k (m,) [N/m].
        rest_length: r (m,) [m].
        direction: unit vectors (m, 3) used where the length is zero.
        out: forces (n, 3) [N], incremented.
    """
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        x, y, z = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1], p[i, 2] - p[j, 2]
        length = np.sqrt(x * x + y * y + z * z)
        pull = stiffness[e] * (length - rest_length[e])
        if length > ZERO_LENGTH:
            fx, fy, fz = pull / length * x, pull / length * y, pull / length * z
        else:
            fx, fy, fz = pull * direction[e, 0], pull * direction[e, 1], pull * direction[e, 2]
        out[i, 0] += fx
        out[i, 1] += fy
        out[i, 2] += fz
        out[j, 0] -= fx
        out[j, 1] -= fy
        out[j, 2] -= fz


def _measure_drag(scene: Scene) -> float:
    """Return the rate of the scene's ether drag [1/s]; raises NotIntegrable for any other filter."""
    v = np.random.default_rng(0).uniform(1.0, 2.0, scene.mesh.rest_positions.shape)
    remaining = reduce(lambda v, filtered: filtered(v), scene.velocity_filters, v) / v
    if not remaining.min() > 0.0 or np.ptp(remaining) > 1e-12 * remaining.max():
        raise NotIntegrable("a filter of the velocity that does not scale all of it by one positive factor")
    return -log(float(np.mean(remaining))) / scene.system.time_step
