"""Symplectic Euler with the number of substeps h that stability requires.

    v <- v + h M^-1 (f - grad E(p)),    p <- p + h v

It is stable while h < 2/omega for the largest omega^2 of M^-1 Hessian (Hairer, Lubich and Wanner, Geometric Numerical
Integration, section I.5). Springs are stiffest under tension, Hessian <= A'KA. The eigenvalues of M^-1 A'KA equal those
of K^(1/2) A M^-1 A'K^(1/2). The largest row sum bounds them (Gershgorin, rows scaled by K^(1/2)):

    omega^2 <= max over springs (i, j) of s_i + s_j,    s_i = sum of the stiffnesses at i / m_i, 0 if i is pinned

The bound is sharp for a single spring, and within 3 % for chains and nets. With shear and bending springs it is up to
1.12 times the largest omega of a sheet, and 1.28 times that of a solid.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import ceil
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from springbench.solvers.iteration import vertex_terms
from springbench.solvers.iteration.iterative_solver import IterativeSolver, SolverState
from springbench.solvers.iteration.solver_info import Citation, SolverInfo
from springbench.solvers.jit.kernel_compilation import jit_kernel
from springbench.solvers.jit.typed_kernel import TypedKernel
from springbench.solvers.kernels.spring_local_step import SpringPackets, add_descent
from springbench.solvers.methods.local_global.prefactored import require_only_springs
from springbench.solvers.methods.time_stepping.explicit_forces import SingleIterateState, pad_rows
from springbench.solvers.methods.time_stepping.substep_choice import STABILITY_SAFETY, require_few_evaluations
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import (
    Positions,
    PreparedSolver,
    ResidualIterate,
    StepProblem,
    System,
)
from springbench.solvers.simd.spring_packets import LANES

_MAX_SPRING_EVALUATIONS = 1e10
"""Maximum number of spring evaluations in a step, tens of seconds: the plainest loop of all explicit methods shows what
they would do where the others are refused."""


@dataclass(frozen=True)
class SymplecticEuler:
    """Symplectic Euler: one iterate, the whole step, independent of stop rule and initial guess.

    Penalty pins are treated as exact, because their weight would require the shortest substeps. Pins move at constant
    velocity, and forces are constant within a step.
    """

    is_minimiser: ClassVar[bool] = False
    is_monotone: ClassVar[bool] = False
    solver_info: ClassVar[SolverInfo] = SolverInfo(
        "explicit",
        Citation(
            "Hairer, Ernst and Lubich, Christian and Wanner, Gerhard",
            2006,
            "Geometric Numerical Integration",
            "10.1007/3-540-30666-8",
        ),
        is_substepping=True,
        is_family_default=True,
        formula="v⁺ = v + h M⁻¹(f − ∇E), p⁺ = p + h v⁺",
        cost="1 pass per substep",
    )

    def prepare(self, system: System) -> PreparedSolver:
        """Prepare the method for a system.

        Raises:
            Unsupported: for energies other than springs, integrators other than implicit Euler, unpinned vertices
                without mass, and steps that need too many substeps.
        """
        springs, n = require_only_springs(system, "symplectic-euler"), system.num_vertices
        vertex_terms.require_implicit_euler(system, "symplectic-euler")
        vertex_terms.require_mass(system, np.where(system.unpinned_mask, system.mass, np.inf), "symplectic-euler")
        omega = bound_max_frequency(system, springs)
        needed = max(1.0, ceil(system.time_step * omega / (2.0 * STABILITY_SAFETY)))
        require_few_evaluations("symplectic-euler", needed, 1, len(springs.edges), _MAX_SPRING_EVALUATIONS)
        soft = int((~system.pins.exact_mask).sum())
        taken = f"; {soft} pins by penalty taken as exact" if soft else ""
        choice = f"{needed:.0f} substeps for vibrations of at most {omega:.3g} rad/s{taken}"
        part = np.where(system.unpinned_mask, 0, -1)
        packets, _ = SpringPackets.from_springs(springs, np.arange(n), part, 1, n, n + 1)
        return PreparedSymplecticEuler(system, packets, int(needed), choice)


def bound_max_frequency(system: System, springs: Springs) -> float:
    """Return a bound of the springs' largest angular frequency [rad/s] in any shape.

    Args:
        system: the system; vertices pinned by penalty count as fixed.
        springs: its springs.
    """
    edges = springs.edges[springs.edges[:, 0] != springs.edges[:, 1]]
    k = springs.stiffness[springs.edges[:, 0] != springs.edges[:, 1]]
    stiffness = np.bincount(edges.ravel(), np.repeat(k, 2), system.num_vertices)
    rate = np.divide(stiffness, system.mass, out=np.zeros(system.num_vertices), where=system.unpinned_mask)
    return float(np.sqrt(rate[edges].sum(axis=1).max(initial=0.0)))


@dataclass(frozen=True, eq=False)
class PreparedSymplecticEuler(IterativeSolver):
    """Symplectic Euler, prepared: SIMD packets of the springs at unpinned vertices, and substeps per step."""

    residual_iterate: ClassVar[ResidualIterate] = "none"

    system: System
    spring_packets: SpringPackets
    num_substeps: int
    description: str
    stats: dict[str, float] = field(default_factory=dict)

    def init_state(self, problem: StepProblem, initial_guess: Positions) -> SolverState:
        """Start a solve whose only iteration is the whole step.

        Args:
            problem: step that is integrated from its start.
            initial_guess: not used.
        """
        return SingleIterateState(*self._integrate_step(problem))

    @cached_property
    def _run_steps(self) -> TypedKernel:
        return TypedKernel(run_symplectic_euler)

    @cached_property
    def _pinned_vertices(self) -> NDArray[np.int64]:
        return self.system.pins.vertices.copy()

    @cached_property
    def _velocity_rate(self) -> NDArray[np.float64]:
        """Change of the velocity in a substep by a unit force (n,) [s/kg].

        It is 0 for pinned vertices.
        """
        s, h = self.system, self.system.time_step / self.num_substeps
        return np.divide(h, s.mass, out=np.zeros(s.num_vertices), where=s.unpinned_mask)

    @cached_property
    def _packed_force(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Memory for the external force [N] in the layout of the packets, and its places there (n, 3)."""
        n, packets = self.system.num_vertices, self.spring_packets
        places = packets.right_hand_side_offset(n + 2)[:n, None] + LANES * np.arange(3)
        return packets.build_right_hand_side(np.zeros(n + 2)), places

    def _integrate_step(self, problem: StepProblem) -> tuple[Positions, Positions]:
        s, pins, start = self.system, self.system.pins.vertices, problem.step_start
        h = s.time_step / self.num_substeps
        begin, end = start.positions[pins], problem.pin_targets.copy()
        p = pad_rows(start.positions, pad_far=True)
        v, (force, places) = pad_rows(start.velocity), self._packed_force
        v.reshape(-1, 4)[pins] = 0.0
        force[places] = problem.external_force
        pinned = self._pinned_vertices, begin, end
        self._run_steps.call(
            self.spring_packets, *pinned, force, self._velocity_rate, h, self.num_substeps, p, v, np.zeros_like(v)
        )
        velocity = v.reshape(-1, 4)[: s.num_vertices, :3].copy()
        velocity[pins] = (end - begin) / s.time_step
        return p.reshape(-1, 4)[: s.num_vertices, :3].copy(), velocity


@jit_kernel
def run_symplectic_euler(packets, pins, begin, end, force, rate, h, count, p, v, acceleration):
    """Run `count` substeps of size h, with the springs in packets of eight vertices.

    The arrays p and v, in rows of four, are overwritten with the result.

    Args:
        packets: packets of the springs.
        pins: vertices (q,) that move uniformly from `begin` to `end`.
        begin, end: positions of the pins (q, 3) [m].
        force: force [N] in the layout of the packets' right-hand side, with zero anchor stiffness.
        rate: h/m (n,) [s/kg], 0 for pinned vertices.
        h: step size [s].
        count: number of substeps.
        p: positions [m].
        v: velocities [m/s].
        acceleration: scratch in rows of four.
    """
    for step in range(1, count + 1):
        for k in range(len(acceleration)):
            acceleration[k] = 0.0
        add_descent(packets, 0, len(packets.packet_start) - 1, p, force, acceleration, 0)
        for i in range(len(rate)):
            for k in range(4 * i, 4 * i + 3):
                v[k] += rate[i] * acceleration[k]
                p[k] += h * v[k]
        left = (count - step) / count
        for q in range(len(pins)):
            for c in range(3):
                p[4 * pins[q] + c] = end[q, c] + left * (begin[q, c] - end[q, c])
