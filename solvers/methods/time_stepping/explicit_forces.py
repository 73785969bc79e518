"""The forces of a system for explicit methods, and a bound of its frequencies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import ArpackError, eigsh
from springbench.solvers.iteration.iterative_solver import SolverState
from springbench.solvers.kernels.iteration_loop import REASON_ITERATIONS, LoopLimits
from springbench.solvers.kernels.padding_coordinate import PADDING_COORDINATE
from springbench.solvers.kernels.quadratic_form_kernels import QuadraticForm
from springbench.solvers.kernels.spring_local_step import SpringPackets
from springbench.solvers.linalg.memory import allocate_aligned
from springbench.solvers.methods.time_stepping.explicit_integrator_kernels import (
    FrameForces,
    MotionRows,
    UniformPinMotion,
)
from springbench.solvers.model.energies.quadratic_energy import Quadratic, drag_of_vertices
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, System, Unsupported, is_lagged

_EIGENVALUE_MARGIN = 1.02
"""Margin for the largest eigenvalue, which is approximated from below to one percent."""


def estimate_max_frequency(system: System) -> float:
    """Return a bound of the largest angular frequency [rad/s], with all pins fixed.

    Springs at their largest stiffness and constant quadratic forms are taken into account.
    """
    free = np.flatnonzero(system.unpinned_mask)
    constant = [e for e in system.energies if isinstance(e, (Springs, Quadratic)) and not is_lagged(e)]
    if not len(free) or not constant:
        return 0.0
    K = reduce(add, (e.stiffness_matrix(system.num_vertices) for e in constant))
    inner = csr_array(K, copy=True) if len(free) == system.num_vertices else csr_array(csr_array(K[free])[:, free])
    slow = 1.0 / np.sqrt(system.mass[free])
    inner.data *= np.repeat(slow, np.diff(inner.indptr))
    inner.data *= slow[inner.indices]
    rows = float(abs(inner).sum(axis=1).max(initial=0.0))  # Gershgorin
    if len(free) < 20 or not rows:
        most = float(np.linalg.eigvalsh(inner.toarray()).max(initial=0.0))
        return _EIGENVALUE_MARGIN * max(most, 0.0) ** 0.5
    try:
        given = np.random.default_rng(0).normal(size=len(free))
        most = float(eigsh(inner, 1, which="LA", tol=1e-2, v0=given, return_eigenvectors=False)[0])
    except ArpackError:
        return rows**0.5
    return min(_EIGENVALUE_MARGIN * most**0.5, rows**0.5)


@dataclass(frozen=True, eq=False)
class ExplicitForces:
    """The forces of a system.

    Attributes:
        springs: all springs.
        drag_rate: rate of the drag of each vertex (n,) [1/s], 0 for pinned ones.
        frame_forces: the forces for the kernels.
        motion_rows: scratch of a motion for the kernels.
    """

    springs: Springs
    drag_rate: NDArray[np.float64]
    frame_forces: FrameForces
    motion_rows: MotionRows

    @classmethod
    def from_system(cls, system: System, solver: str) -> ExplicitForces:
        """Build the forces of a system.

        Args:
            system: system of springs, constant quadratic forms and drag on vertices.
            solver: name of the method for the error message.

        Raises:
            Unsupported: other energies.
        """
        n = system.num_vertices
        springs = Springs.from_parts([energy for energy in system.energies if isinstance(energy, Springs)])
        drag, load, forms = np.zeros(n), np.zeros((n, 3)), list[csr_array]()
        for energy in system.energies:
            if (c := drag_of_vertices(energy)) is not None:
                drag += c
            elif isinstance(energy, Quadratic) and not is_lagged(energy):
                forms.append(energy.stiffness_matrix(n))
                energy.add_projection(load, load)
            elif not isinstance(energy, Springs):
                raise Unsupported(
                    f"{solver}: supports springs, bending and drag on vertices; the scene has {type(energy).__name__} "
                    "as well"
                )
        form = QuadraticForm.from_matrix(csr_array(reduce(add, forms))) if forms else QuadraticForm.empty_form()
        part = np.where(system.unpinned_mask, 0, -1)
        packets, _ = SpringPackets.from_springs(springs, np.arange(n), part, 1, n, n + 1)
        drag = np.divide(drag, system.mass, out=np.zeros(n), where=system.unpinned_mask)
        pins, zero = system.pins.vertices.copy(), np.zeros((n, 3))
        forces = FrameForces(
            packets,
            packets.build_right_hand_side(np.zeros(n + 2)),
            load,
            form.pairs,
            form.pair_weight,
            form.vertex_weight if form.vertex_weight.any() else form.vertex_weight[:0],
            _expand_to_rows(np.divide(1.0, system.mass, out=np.zeros(n), where=system.unpinned_mask)),
            _expand_to_rows(drag),
            UniformPinMotion(pins, *np.zeros((2, len(pins), 3))),
        )
        return cls(springs, drag, forces, MotionRows(pad_rows(zero, pad_far=True), pad_rows(zero), pad_rows(zero)))


def _expand_to_rows(of_vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Repeat the value of each vertex for the three coordinates of its row.

    The fourth number of a row and the padding rows are zero.
    """
    return pad_rows(np.repeat(of_vertices[:, None], 3, axis=1))


def pad_rows(x: Positions, *, pad_far: bool = False) -> NDArray[np.float64]:
    """Return vectors in rows of four, with two padding rows.

    Args:
        x: vectors of the vertices (n, 3).
        pad_far: whether the last row is far away from all vertices, as the ends of padding springs need.

    Returns:
        Array (4 (n + 2),), with zeros in the fourth column.
    """
    out = allocate_aligned(4 * (len(x) + 2))
    out.reshape(-1, 4)[: len(x), :3] = x
    if pad_far:
        out[4 * (len(x) + 1)] = PADDING_COORDINATE
    return out


class SingleIterateState(SolverState):
    """A whole step as the only iterate, repeated."""

    def __init__(self, p: Positions, v: Positions | None) -> None:
        """Create the state from the end of the step.

        Args:
            p: positions (n, 3) [m].
            v: velocity (n, 3) [m/s], or None if it follows from the positions.
        """
        self.positions, self.velocity = p, v

    def step_state(self) -> bool:
        """Return True; the step is complete from the start."""
        return True

    def run_iterations(self, limits: LoopLimits) -> tuple[int, float, int]:
        """Return one iteration, or none if the limits allow none, without a residual."""
        return min(1, limits.max_iterations), float("nan"), REASON_ITERATIONS
