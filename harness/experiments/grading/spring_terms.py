"""Terms of a scene for which the assignment's local-global method has matrices.

    springs (A, K, r), masses (M), pins (C, w), external forces (f)

Liu et al. 2013, section 4.1. Other effects have no place in the formulas, so scenes with them are refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.harness.errors import InputError, InputMistake, format_allowed_names
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import (
    COARSE_TO_FINE,
    INITIAL_GUESSES,
    MotionState,
    build_initial_state,
    build_problem,
)
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.energies.edge_energy import unit_directions
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, StepProblem


@dataclass(frozen=True, eq=False)
class SpringTerms:
    """The terms of a scene, as arrays.

    Attributes:
        edges: E, vertex pairs (m, 2).
        stiffness: k (m,) [N/m].
        rest_length: r (m,) [m].
        rest_direction: directions (m, 3) of springs of zero length.
        mass: (n,) [kg].
        time_step: dt [s].
        pinned: pinned vertices (q,), in the order of the rows of C.
        weight: w (q,) [N/m], infinite for exact pins.
    """

    edges: NDArray[np.int64]
    stiffness: NDArray[np.float64]
    rest_length: NDArray[np.float64]
    rest_direction: NDArray[np.float64]
    mass: NDArray[np.float64]
    time_step: float
    pinned: NDArray[np.int64]
    weight: NDArray[np.float64]

    @property
    def num_vertices(self) -> int:
        """Number of vertices n."""
        return len(self.mass)

    @property
    def soft_mask(self) -> NDArray[np.bool_]:
        """Which pins are penalties (q,); the others are exact."""
        return np.isfinite(self.weight)

    @property
    def free_vertices(self) -> NDArray[np.int64]:
        """Vertices that are not pinned exactly."""
        return np.setdiff1d(np.arange(self.num_vertices), self.pinned[~self.soft_mask])

    def build_incidence(self) -> csr_array:
        """Build A (m, n)."""
        return system_matrix_assembly.signed_incidence_matrix_sparse(self.edges, self.num_vertices)

    def build_selection(self) -> csr_array:
        """Build C (q, n)."""
        return system_matrix_assembly.selection_matrix_sparse(self.pinned, self.num_vertices)

    def build_system_matrix(self) -> csr_array:
        """Build Q (n, n) [N/m]; exact pins contribute nothing."""
        soft = self.soft_mask
        return system_matrix_assembly.system_matrix_sparse(
            self.build_incidence(),
            self.stiffness,
            system_matrix_assembly.mass_matrix_sparse(self.mass),
            self.time_step,
            self.build_selection()[soft],
            self.weight[soft],
        )

    def project_springs(self, p: Positions) -> Positions:
        """Compute d (m, 3) [m] at p (n, 3) [m]: spring directions times rest lengths."""
        i, j = self.edges.T
        _, unit = unit_directions(p[i] - p[j], self.rest_direction)
        return self.rest_length[:, None] * unit


def collect_spring_terms(scene: Scene) -> SpringTerms:
    """Collect the terms of a scene.

    Raises:
        InputError: the scene has terms that the formulas do not have.
    """
    system = scene.system
    others = [type(energy).__name__ for energy in system.energies if not isinstance(energy, Springs)]
    if system.length_constraints:
        others.append("exact lengths")
    if scene.alternate_scene:
        others.append("alternate_time_step")
    if others:
        problem = f"the scene has {', '.join(others)}; the formulas have springs, masses, forces and pins only"
        raise InputError(InputMistake(f"{problem}; leave out such effects", key="effects"))
    springs = scene.all_springs
    if not len(springs.edges):
        raise InputError(InputMistake("the scene has no springs; add the effect `springs`", key="effects"))
    return SpringTerms(
        springs.edges,
        springs.stiffness,
        springs.rest_length,
        springs.rest_direction,
        system.mass,
        system.time_step,
        system.pins.vertices,
        system.pins.weight,
    )


def build_graded_scene(spec: SceneSpec, size: int) -> Scene:
    """Build a scene with implicit Euler.

    Args:
        spec: the scene.
        size: mesh size, ignored by a mesh from a file.

    Raises:
        InputError: the parts of the scene do not fit together; the mistakes name its file.
    """
    try:
        return build_scene(spec, size)
    except InputError as error:
        raise InputError([replace(one, file=one.file or spec.path) for one in error.mistakes]) from error


def compute_position_before_start(scene: Scene) -> Positions:
    """Compute the positions (n, 3) [m] one step before the start, from the initial velocity."""
    begun = build_initial_state(scene).motion
    return begun.positions - scene.system.time_step * begun.velocity


def build_step_problem(
    scene: Scene, current: Positions, previous: Positions, index: int, initial_guess: str = "previous"
) -> StepProblem:
    """Build the problem of the step that follows two positions.

    Args:
        scene: scene with implicit Euler.
        current: p^t (n, 3) [m].
        previous: p^(t-dt) (n, 3) [m].
        index: number of the last step, 0 at the start.
        initial_guess: a key of `INITIAL_GUESSES`; or COARSE_TO_FINE, for which the step starts as with "previous",
            without a solution on a coarser mesh.

    Raises:
        InputError: there is no such initial guess.
    """
    if initial_guess == COARSE_TO_FINE:
        initial_guess = "previous"
    if initial_guess not in INITIAL_GUESSES:
        expected = format_allowed_names(initial_guess, [*INITIAL_GUESSES, COARSE_TO_FINE])
        raise InputError(InputMistake(f"got {initial_guess!r}; expected {expected}", key="initial_guess"))
    velocity = (current - previous) / scene.find_step_scene(max(0, index - 1)).system.time_step
    return build_problem(scene, MotionState(Motion(current, velocity), None, index), initial_guess)
