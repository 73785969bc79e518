"""Barrier contact of primitive pairs: an energy of positions that limits the step size.

`springbench.solvers.contact.potentials.barrier` defines the energy. The candidates and the collision-free step size are
those of `springbench.solvers.contact.broad_phase.candidate_cache`.

`SelfContact` is contact of a mesh with itself, `ObstacleContact` that of a mesh with the surfaces of obstacles. The
vertices of obstacles follow those of the mesh in all arrays. The energy of a step has the obstacles at their end
positions, to which they move linearly from their start positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from springbench.solvers.contact import collisions
from springbench.solvers.contact.broad_phase import candidate_cache
from springbench.solvers.contact.broad_phase.candidate_cache import CachedCandidates, CandidateSource
from springbench.solvers.contact.collisions import Candidates, Collisions, pad_positions
from springbench.solvers.contact.contact_work import ObstacleWork
from springbench.solvers.contact.lagged_friction import MAX_FRICTION_ITERATIONS
from springbench.solvers.contact.potentials import barrier
from springbench.solvers.contact.potentials.barrier_hessian import (
    add_barrier_hessian,
    build_hessian_blocks,
    collect_block_vertices,
    mask_static_vertices,
)
from springbench.solvers.contact.potentials.friction import NO_TANGENTIAL_COLLISIONS, TangentialCollisions
from springbench.solvers.contact.potentials.hessian_blocks import PackedBlocks, ReusableBuffer
from springbench.solvers.model.step_problem import Positions, StepStart

FloatArray = NDArray[np.float64]

_CANDIDATE_INFLATION = 1.25
"""Query radius relative to the activation distance: pairs this close may become active during a solve."""


ObstacleMotion = Callable[[float], Positions]
"""Function of a time [s] that returns the obstacle vertices (o, 3) [m]."""

ComovingMap = Callable[[float, float, Positions], list[Positions]]
"""Function of two times [s] and positions (n, 3) [m] that returns these moved with each moving obstacle."""


class _CollisionState(NamedTuple):
    """Active collisions at p (n, 3), with energy [J] and gradient (n, 3) [N].

    buffer: memory of the collisions.
    """

    p: Positions
    collisions: Collisions
    energy: float
    gradient: Positions
    buffer: Collisions


@dataclass(frozen=True, eq=False)
class BarrierContact:
    """Barrier energy of primitive pairs, with lagged friction.

    Attributes:
        collision_mesh: source of the candidates.
        friction: friction coefficient mu.
        eps_v: speed [m/s] below which a pair counts as sticking.
        friction_iterations: maximum number of solves of a step, each with the normal forces of the previous one.
        candidate_caches: cached candidates, the most recent one first.
        recent_states: collisions at the last two positions; energies, gradients and Hessians are queried alternately.
        block_buffer: memory of the Hessian blocks.
        tangential_collisions: friction of the current step.
    """

    collision_mesh: CandidateSource
    friction: float = 0.0
    eps_v: float = 1e-3
    friction_iterations: int = MAX_FRICTION_ITERATIONS
    candidate_caches: list[CachedCandidates] = field(default_factory=list[CachedCandidates])
    recent_states: list[_CollisionState] = field(default_factory=list[_CollisionState])
    block_buffer: ReusableBuffer = field(default_factory=ReusableBuffer)
    tangential_collisions: TangentialCollisions = NO_TANGENTIAL_COLLISIONS

    @property
    def activation_distance(self) -> float:
        """Distance [m] beyond which the barrier vanishes."""
        return self.collision_mesh.min_distance + self.collision_mesh.dhat

    def begin_step(self, start: StepStart) -> Self:
        """Return the energy of a step; pairs active at `start.normal_force_positions` have friction."""
        if not self.friction:
            return self
        begun = self.append_obstacle_positions(start.positions)
        tangential = self._build_tangential_collisions(
            begun
            if start.normal_force_positions is None
            else self.append_obstacle_positions(start.normal_force_positions),
            begun,
            start,
        )
        return self if tangential is self.tangential_collisions else replace(self, tangential_collisions=tangential)

    def _build_tangential_collisions(
        self, p: Positions, start_positions: Positions, start: StepStart
    ) -> TangentialCollisions:
        """Build friction. p: all vertices where normal forces are evaluated; start_positions: at the step's start."""
        if candidate_cache.has_no_active_collisions(self.collision_mesh, self.candidate_caches, p):
            return NO_TANGENTIAL_COLLISIONS
        return TangentialCollisions.from_collisions(
            self._state_at(p).collisions, start_positions, self.friction, self.eps_v * (start.stage_time - start.time)
        )

    def append_obstacle_positions(self, p: Positions) -> Positions:
        """Return the positions of all vertices, those of the mesh (n, 3) first."""
        return p if p.flags.carray else np.array(p, order="C")

    def append_obstacle_displacements(self, direction: Positions) -> Positions:
        """Return the displacements of all vertices, those of the mesh (n, 3) first."""
        return direction if direction.flags.carray else np.array(direction, order="C")

    def find_candidates(self, p: Positions) -> Candidates:
        """Return all pairs active at p, positions (N, 3) of all vertices, and possibly more."""
        return candidate_cache.find_candidates(self.collision_mesh, self.candidate_caches, p)

    def value(self, p: Positions) -> float:
        """Return the energy [J] at p (n, 3); infinite if a gap is closed."""
        p = self.append_obstacle_positions(p)
        if not candidate_cache.has_no_active_collisions(self.collision_mesh, self.candidate_caches, p):
            if not np.isfinite(p).all():
                return np.inf
            pressed = self._state_at(p).energy
        else:
            pressed = 0.0
        return pressed + self.tangential_collisions.value(p) if len(self.tangential_collisions.vertices) else pressed

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient, with that of friction.

        Args:
            p: positions (n, 3) [m].
            out: gradient (n, 3) [N], updated; unchanged if a coordinate of p is not finite.
        """
        n, p = len(p), self.append_obstacle_positions(p)
        if not candidate_cache.has_no_active_collisions(self.collision_mesh, self.candidate_caches, p):
            if not np.isfinite(p).all():
                return
            met = self._state_at(p)
            if len(met.collisions.vertices):
                out += met.gradient[:n]
        friction = self.friction_gradient(p[:n])
        if friction is not None:
            out += friction

    def friction_gradient(self, p: Positions) -> Positions | None:
        """Return the gradient of friction alone [N], (n, 3); None without contact."""
        if not len(self.tangential_collisions.vertices):
            return None
        n, p = len(p), self.append_obstacle_positions(p)
        out = np.zeros_like(p)
        self.tangential_collisions.add_gradient(p, out)
        return out[:n]

    def friction_potential(self, p: Positions) -> float:
        """Return the part of friction in the energy [J] at p (n, 3)."""
        if not len(self.tangential_collisions.vertices):
            return 0.0
        return float(self.tangential_collisions.value(self.append_obstacle_positions(p)))

    def obstacle_work(self, p: Positions, start: Positions) -> ObstacleWork:
        """Return the work of the obstacles in the step, zero without obstacles.

        Args:
            p: positions (n, 3) [m] of the stage, whose forces act.
            start: positions (n, 3) [m] at the step's start.
        """
        return ObstacleWork()

    def hessian_blocks(self, p: Positions, negative_fraction: float = 1.0) -> PackedBlocks:
        """Return the Hessian blocks [N/m] of all active collisions.

        Args:
            p: positions (n, 3) [m].
            negative_fraction: fraction of the negative curvature to include; 0 gives positive semidefinite blocks.
        """
        n, p = len(p), self.append_obstacle_positions(p)
        return build_hessian_blocks(
            self._state_at(p).collisions, self.tangential_collisions, p, n, negative_fraction, self.block_buffer
        )

    def block_vertices(self, p: Positions) -> NDArray[np.int64]:
        """Return the vertices (a, 4) of all Hessian blocks at p (n, 3); -1 for none."""
        return collect_block_vertices(
            self._state_at(self.append_obstacle_positions(p)).collisions, self.tangential_collisions, len(p)
        )

    def candidate_vertices(self, p: Positions) -> NDArray[np.int64]:
        """Return the vertices (k, 4) of pairs near p (n, 3); -1 for none.

        The result is independent of the caches.
        """
        return mask_static_vertices(
            self.collision_mesh.find_proximity_candidates(
                self.append_obstacle_positions(p), _CANDIDATE_INFLATION * self.activation_distance
            ).vertices,
            self.tangential_collisions,
            len(p),
        )

    def add_hessian_blocks(
        self, p: Positions, negative_fraction: float, block_indices: NDArray[np.int64], values: FloatArray
    ) -> None:
        """Add the Hessian blocks [N/m] at p to existing 3x3 blocks.

        Args:
            p: positions (n, 3) [m].
            negative_fraction: fraction of the negative curvature to include.
            block_indices: target block of each vertex pair, (a, 16); -1 for none.
            values: blocks (b, 3, 3) [N/m], updated.
        """
        p = self.append_obstacle_positions(p)
        add_barrier_hessian(
            self._state_at(p).collisions, self.tangential_collisions, p, negative_fraction, block_indices, values
        )

    def _state_at(self, p: Positions) -> _CollisionState:
        """Return the collisions at p, positions (N, 3) of all vertices."""
        for met in self.recent_states:
            if np.array_equal(met.p, p):
                return met
        pairs = self.find_candidates(p)
        many = len(pairs.vertices)
        if not many:
            nothing = collisions.allocate_collisions(0, pairs.min_distance, pairs.dhat)
            return _CollisionState(p, nothing, 0.0, p, nothing)
        gradient = np.zeros_like(p)
        space = self.recent_states.pop(0).buffer if len(self.recent_states) > 1 else None
        if space is None or len(space.vertices) < many:
            space = collisions.allocate_collisions(many, pairs.min_distance, pairs.dhat)
        near = collisions.build_collisions(pairs, pad_positions(p), space)
        self.recent_states.append(
            _CollisionState(p.copy(), near, barrier.energy_and_gradient(near, p, gradient), gradient, space)
        )
        return self.recent_states[-1]

    def hessian(self, p: Positions) -> csr_array:
        """Return the Hessian [N/m], (3n, 3n)."""
        return self.hessian_blocks(p).assemble_matrix(len(p))

    def collision_free_step_size(self, p: Positions, direction: Positions) -> float:
        """Return the largest step size up to 1 at which all gaps stay open.

        Args:
            p: positions (n, 3) [m].
            direction: displacements (n, 3) [m].

        Returns:
            Step size in [0, 1]; 0 if a gap is closed at p. All smaller step sizes are collision-free too.
        """
        return candidate_cache.find_collision_free_step_size(
            self.collision_mesh,
            self.candidate_caches,
            self.append_obstacle_positions(p),
            self.append_obstacle_displacements(direction),
        )

    def collision_free_step_size_moving(self, p: Positions, direction: Positions, start_fraction: float) -> float:
        """Return the largest collision-free step size while the obstacles move as well.

        Args:
            p: positions (n, 3) [m].
            direction: displacements (n, 3) [m] over the remainder of the step.
            start_fraction: fraction of their motion at which the obstacles start.

        Returns:
            Fraction of the remaining displacements, in [0, 1].
        """
        return self.collision_free_step_size(p, direction)

    def at_fraction(self, fraction: float) -> Self:
        """Return the energy with obstacles at a fraction of their motion, 1 at its end."""
        return self

    def comoving_positions(self, p: Positions) -> list[Positions]:
        """Return the end positions of p (n, 3) if it moved with each moving obstacle."""
        return []

    def find_violated_pairs(self, p: Positions) -> list[tuple[NDArray[np.int64], bool, float]]:
        """Return the pairs that violate their minimum distance at p (n, 3), the closest first.

        Returns:
            For each pair its vertices (4,), whether it is one of edges, and its distance [m].
        """
        p = self.append_obstacle_positions(p)
        pairs = self.find_candidates(p)
        apart = barrier.compute_distances(pairs, p)
        bad = np.flatnonzero(~(apart > pairs.distance_scale * pairs.min_distance))
        bad = bad[np.argsort(apart[bad], kind="stable")]
        return [(pairs.vertices[e], bool(e >= pairs.num_point_triangle), float(apart[e])) for e in bad.tolist()]


@dataclass(frozen=True, eq=False)
class SelfContact(BarrierContact):
    """Contact of a surface with itself."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ObstacleContact(BarrierContact):
    """Contact of a surface with obstacles.

    Attributes:
        obstacle_positions_at: time [s] -> obstacle vertices (o, 3) [m]; the same array at all times if none moves.
        comoving_map: two times and positions (n, 3) -> these positions moved with each moving obstacle.
        start_positions: obstacle vertices (o, 3) [m] at the step's start.
        current_positions: obstacle vertices (o, 3) [m] of the evaluation.
        end_positions: obstacle vertices (o, 3) [m] at the step's end.
        step_times: start and end of the step [s], if an obstacle moves in it.
    """

    obstacle_positions_at: ObstacleMotion
    comoving_map: ComovingMap
    start_positions: Positions
    current_positions: Positions
    end_positions: Positions
    step_times: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def from_collision_mesh(
        cls,
        collision_mesh: CandidateSource,
        obstacle_positions_at: ObstacleMotion,
        comoving_map: ComovingMap,
        friction: float,
        eps_v: float,
        friction_iterations: int = MAX_FRICTION_ITERATIONS,
    ) -> Self:
        """Build the contact at time 0, before any step.

        Args:
            collision_mesh: source of the candidates.
            obstacle_positions_at: time [s] -> obstacle vertices (o, 3) [m].
            comoving_map: two times and positions (n, 3) -> these positions moved with each moving obstacle.
            friction: friction coefficient mu.
            eps_v: speed [m/s] below which a pair counts as sticking.
            friction_iterations: maximum number of solves of a step.
        """
        now = obstacle_positions_at(0.0)
        return cls(
            collision_mesh,
            friction,
            eps_v,
            friction_iterations,
            obstacle_positions_at=obstacle_positions_at,
            comoving_map=comoving_map,
            start_positions=now,
            current_positions=now,
            end_positions=now,
        )

    def begin_step(self, start: StepStart) -> Self:
        """Return the energy of a step, with obstacles at their end positions."""
        begun, end = self.obstacle_positions_at(start.time), self.obstacle_positions_at(start.stage_time)
        step, is_at_rest = self, begun is end and end is self.current_positions
        if not is_at_rest:
            step = replace(
                self,
                start_positions=begun,
                current_positions=end,
                end_positions=end,
                step_times=(start.time, start.stage_time),
            )
        if not self.friction:
            return step
        first = np.concatenate([start.positions, begun])
        pressed = first if start.normal_force_positions is None else np.concatenate([start.normal_force_positions, end])
        tangential = step._build_tangential_collisions(pressed, first, start)
        return step if tangential is step.tangential_collisions else replace(step, tangential_collisions=tangential)

    def append_obstacle_positions(self, p: Positions) -> Positions:
        """Return the positions of all vertices, those of the mesh (n, 3) first."""
        return np.concatenate([p, self.current_positions])

    def append_obstacle_displacements(self, direction: Positions) -> Positions:
        """Return the displacements of all vertices, with zeros for the obstacles."""
        return np.concatenate([direction, np.zeros_like(self.current_positions)])

    def collision_free_step_size_moving(self, p: Positions, direction: Positions, start_fraction: float) -> float:
        """Return the largest collision-free step size while obstacles move to their end positions.

        Args:
            p: positions (n, 3) [m].
            direction: displacements (n, 3) [m] over the remainder of the step.
            start_fraction: fraction of their motion at which the obstacles start.

        Returns:
            Fraction of the remaining displacements, in [0, 1]; 0 if a gap is closed at p.
        """
        there = self.at_fraction(start_fraction).current_positions
        displacement = np.concatenate([direction, self.end_positions - there])
        return candidate_cache.find_collision_free_step_size(
            self.collision_mesh, self.candidate_caches, np.concatenate([p, there]), displacement
        )

    def at_fraction(self, fraction: float) -> Self:
        """Return this energy with obstacles at a fraction of their motion in the step."""
        return (
            self
            if self.start_positions is self.end_positions
            else replace(
                self, current_positions=self.start_positions + fraction * (self.end_positions - self.start_positions)
            )
        )

    def comoving_positions(self, p: Positions) -> list[Positions]:
        """Return the end positions of p (n, 3) if it moved with each moving obstacle."""
        return self.comoving_map(*self.step_times, p)

    def obstacle_work(self, p: Positions, start: Positions) -> ObstacleWork:
        """Return the work of the obstacles from the step's start to its stage.

        Args:
            p: positions (n, 3) [m] of the stage, whose forces act.
            start: not used; the displacements are those of the obstacle vertices.
        """
        if self.start_positions is self.end_positions:
            return ObstacleWork()
        n, p, moved = len(p), self.append_obstacle_positions(p), self.end_positions - self.start_positions
        pressed, friction = self._state_at(p).gradient[n:], np.zeros_like(p)
        self.tangential_collisions.add_gradient(p, friction)
        normal_work = np.einsum("ij,ij->", pressed, moved) if len(self._state_at(p).collisions.vertices) else 0.0
        return ObstacleWork(float(normal_work), float(np.einsum("ij,ij->", friction[n:], moved)))
