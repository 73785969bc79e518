"""Random networks for property-based tests: small enough to shrink, and described by a handful of numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from springbench.harness.scenes.mesh.network_mesh import NetworkMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import MotionState
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.integrators import INTEGRATORS, Motion
from springbench.solvers.model.step_problem import DirichletPins, Positions, StepProblem, StepStart, System
from springbench.solvers.registry import SOLVERS, load_target

ALL = {name: load_target(target)() for name, target in SOLVERS.items()}
MINIMISERS = {name: solver for name, solver in ALL.items() if solver.is_minimiser}

EPS = float(np.finfo(float).eps)
DT = 1 / 30


@dataclass(frozen=True)
class Case:
    """A random network: n vertices, m springs, seed of all numbers; powers of ten of the stiffness number k dt^2/m and
    of how far stiffnesses lie apart; pinned: how many vertices."""

    n: int
    m: int
    seed: int
    number: float
    spread: float
    pinned: int

    @property
    def worst(self) -> float:
        """max(1, k dt^2/m) of the stiffest spring, at most."""
        return 10.0 ** max(0.0, self.number + self.spread)

    def problem(self) -> StepProblem:
        """A step of the network, which moves and is pushed."""
        rng, rest, system = self._draw_network()
        n, q = self.n, self.pinned
        p, v = rest + 0.3 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
        current = p.copy()
        current[:q] = rest[:q]
        start = StepStart(p, v, 0.0, p, 1.0 / DT, DT)
        force = rng.normal(size=(n, 3))
        return StepProblem(system, p + DT * v, force, rest[:q], current, current, start)

    def flying(self) -> tuple[StepProblem, Positions]:
        """A step of the network at its rest lengths, as a whole in flight, without pins and forces; where it ends."""
        problem = replace(self, pinned=0).problem()
        springs, p = springs_of(problem), problem.step_start.positions
        system = replace(problem.system, energies=(replace(springs, rest_length=springs.edge_lengths(p)),))
        v = np.tile(problem.step_start.velocity[0], (self.n, 1))
        start, on = replace(problem.step_start, velocity=v), p + DT * v
        return replace(
            problem, system=system, inertial_target=on, external_force=np.zeros_like(p), step_start=start
        ), on

    def build_free_scene(self, integrator: str) -> tuple[Scene, MotionState]:
        """The network without pins and forces, as a scene to be stepped, and a start that moves and is stretched."""
        rng, rest, system = replace(self, pinned=0)._draw_network()
        mesh = NetworkMesh(positions=tuple(map(tuple, rest.tolist()))).build_mesh()
        by = INTEGRATORS[integrator]
        none = np.empty((0, 3))
        system = replace(system, inertia_factor=by.inertia_factor, velocity_factor=by.velocity_factor)
        scene = Scene(mesh, system, np.zeros_like(rest), (), (), none, (0.0, 0.0, 0.0), integrator=by)
        p, v = rest + 0.3 * rng.normal(size=rest.shape), rng.normal(size=rest.shape)
        return scene, MotionState(Motion(p, v), None, 0)

    def _draw_network(self) -> tuple[np.random.Generator, Positions, System]:
        """The generator, the rest shape (n, 3) [m], and the system: springs and pins."""
        rng, n = np.random.default_rng(self.seed), self.n
        rest, first = rng.normal(size=(n, 3)), rng.integers(0, n, self.m)
        second = (first + rng.integers(1, n, self.m)) % n  # never itself; twins are welcome
        mass = rng.uniform(0.5, 1.5, n)
        k = 10.0 ** (self.number + self.spread * rng.uniform(-0.5, 0.5, self.m)) / DT**2
        springs = Springs.from_rest_shape(rest, np.stack([first, second], axis=1), k)
        pins = DirichletPins(np.arange(self.pinned), np.where(np.arange(self.pinned) % 2, 1e8, np.inf))
        return rng, rest, System(mass, DT, (springs,), pins)


Map = Callable[[Positions], Positions]


def rotate_problem(problem: StepProblem, seed: int, mirror: bool) -> tuple[StepProblem, Map]:
    """The problem turned at random, mirrored and shifted, and what that does to positions."""
    rng = np.random.default_rng(seed)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R = R * (np.sign(np.linalg.det(R)) * (-1.0 if mirror else 1.0))
    shift, springs = rng.normal(size=3), springs_of(problem)
    system = replace(problem.system, energies=(replace(springs, rest_direction=springs.rest_direction @ R.T),))
    return replace(
        transform_problem(problem, lambda p: p @ R.T + shift, lambda v: v @ R.T), system=system
    ), lambda p: p @ R.T + shift


def renumber_problem(problem: StepProblem, seed: int) -> tuple[StepProblem, Map]:
    """The problem with its vertices and springs in another order, some springs' ends exchanged, and what that does to
    positions."""
    rng, springs, pins = np.random.default_rng(seed), springs_of(problem), problem.system.pins
    place = rng.permutation(problem.system.num_vertices)  # where vertex i goes
    back = np.argsort(place)
    rows, flip = rng.permutation(len(springs.edges)), rng.random((len(springs.edges), 1)) < 0.5
    edges = np.where(flip, place[springs.edges][:, ::-1], place[springs.edges])[rows]
    direction = np.where(flip, -springs.rest_direction, springs.rest_direction)[rows]
    renamed = Springs(edges, springs.stiffness[rows], springs.rest_length[rows], direction)
    where = np.argsort(place[pins.vertices])
    moved = DirichletPins(place[pins.vertices][where], pins.weight[where])
    system = System(problem.system.mass[back], problem.system.time_step, (renamed,), moved)
    other = transform_problem(
        replace(problem, pin_targets=problem.inertial_target), lambda p: p[back], lambda v: v[back]
    )
    return replace(other, system=system, pin_targets=problem.pin_targets[where]), lambda p: p[back]


def transform_problem(problem: StepProblem, places: Map, vectors: Map) -> StepProblem:
    """The problem with `places` applied to its positions [m] and `vectors` to its forces and velocities."""
    start = problem.step_start
    begun = replace(
        start,
        positions=places(start.positions),
        velocity=vectors(start.velocity),
        velocity_origin=places(start.velocity_origin),
    )
    moved = {
        key: places(getattr(problem, key))
        for key in ("inertial_target", "pin_targets", "current_positions", "initial_guess")
    }
    return replace(problem, external_force=vectors(problem.external_force), step_start=begun, **moved)


def springs_of(problem: StepProblem) -> Springs:
    """Its only energy."""
    (springs,) = problem.system.energies
    assert isinstance(springs, Springs)
    return springs


def networks(stiffest: float = 5.0, pinned: int = 2) -> st.SearchStrategy[Case]:
    """Networks with stiffness numbers of 1e-6 to 10^stiffest; pinned: vertices at most."""
    return st.builds(
        Case,
        n=st.integers(2, 9),
        m=st.integers(0, 16),
        seed=st.integers(0, 2**16),
        number=st.floats(-6, stiffest),
        spread=st.floats(0, 3),
        pinned=st.integers(0, pinned),
    )


def examples(count: int) -> settings:
    """So many examples of each property and method, or what `--hypothesis-profile=search` requests."""
    return settings() if settings.get_current_profile_name() == "search" else settings(max_examples=count)
