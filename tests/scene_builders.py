"""Scenes, networks and step problems for the tests, bound by the harness as a run binds them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from springbench.harness.reference.reference_evaluator import assemble_stiffness
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect as PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect as SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh, NetMesh
from springbench.harness.scenes.mesh.solid_meshes import BlockMesh, TowerMesh
from springbench.harness.scenes.mesh.surface_meshes import SkirtMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.scene_spec import MeshSource, SceneSpec
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, simulate_scene
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.reference_local_global import DenseLocalGlobal, SparseLocalGlobal
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits
from springbench.solvers.model.integrators import SingleStageIntegrator
from springbench.solvers.model.step_problem import (
    DirichletPins,
    Positions,
    Solver,
    StepProblem,
    StepStart,
    StopRule,
    System,
)

LOCAL_GLOBAL_BACKENDS: tuple[Solver, ...] = (DenseLocalGlobal(), SparseLocalGlobal(), CompiledLocalGlobal())
"""The three ways to do one and the same local-global iteration."""

CLOTH_SCENE_YAML = """
mesh: {kind: grid}
mass: 0.3
time_step: 1/30
frames: 2
default_size: 4
effects: [{kind: springs, stretch: 300}, {kind: gravity}, {kind: pins, parts: [top_corners]}]
"""
"""A scene's file: a small cloth pinned at two corners, for two steps."""


def build_test_scene(
    mesh: MeshSource,
    *effects: SceneEffect,
    size: int,
    mass: float = 1.0,
    time_step: float = 1 / 30,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """A scene of models, as a scene file declares them."""
    spec = SceneSpec(
        mesh=mesh,
        mass=mass,
        time_step=time_step,
        frames=1,
        velocity=velocity,
        effects=effects,
        path=Path("scene.yaml"),
    )
    return build_scene(spec, size)


def build_cloth(size: int, weight: float | str = 1e10, stretch: float = 300.0) -> Scene:
    """A level cloth that falls, pinned at two corners."""
    pins = PinsEffect.model_validate({"parts": ["top_corners"], "weight": weight})
    return build_test_scene(
        GridMesh(), SpringsEffect(stretch=stretch, shear=stretch / 5), GravityEffect(), pins, size=size
    )


SCENE_BUILDERS: dict[str, Callable[[float | str], Scene]] = {
    "single-spring": lambda weight: build_test_scene(
        ChainMesh(), SpringsEffect(stretch=500.0), GravityEffect(), _build_pins("first", weight), size=2
    ),
    "chain": lambda weight: build_test_scene(
        ChainMesh(length=2.0), SpringsEffect(stretch=500.0), GravityEffect(), _build_pins("ends", weight), size=10
    ),
    "net": lambda weight: build_test_scene(
        NetMesh(), SpringsEffect(stretch=300.0), GravityEffect(), _build_pins("corners", weight), size=5
    ),
    "cloth": lambda weight: build_cloth(8, weight),
    "stiff-cloth": lambda weight: build_cloth(40, weight, stretch=1e5),
    "tower": lambda weight: build_test_scene(
        TowerMesh(), SpringsEffect(stretch=2e6), GravityEffect(), _build_pins("base", weight), size=12, mass=1000.0
    ),
    "block": lambda weight: build_test_scene(
        BlockMesh(), SpringsEffect(stretch=2e5), GravityEffect(), _build_pins("left", weight), size=9, mass=100.0
    ),
    "skirt": lambda weight: build_test_scene(
        SkirtMesh(), SpringsEffect(stretch=200.0, shear=20.0), GravityEffect(), _build_pins("top", weight), size=30
    ),
}
"""Scenes by name, made with a pin weight [N/m] or "exact"."""


def _build_pins(part: str, weight: float | str) -> PinsEffect:
    return PinsEffect.model_validate({"parts": [part], "weight": weight})


def build_first_problem(scene: Scene, initial_guess: str = "previous") -> StepProblem:
    """The problem of a scene's first step."""
    return build_problem(scene, build_initial_state(scene), initial_guess)


def simulate_trajectory(
    scene: Scene, solver: Solver, frames: int, *, initial_guess: str = "previous", iterations: int = 50
):
    """The positions (frames, n, 3) [m] after each step."""
    steps = simulate_scene(
        scene, solver.prepare(scene.system), StopRule(iterations), initial_guess=initial_guess, frames=frames
    )
    return np.array([step.positions.copy() for step in steps])


def compute_static_shape(scene: Scene, *, iterations: int = 20_000, rtol: float = 1e-10) -> Positions:
    """Where a scene comes to rest, (n, 3) [m]: one step so long that inertia (M/dt^2) weighs nothing."""
    system = replace(scene.system, time_step=1e6)
    stated = build_first_problem(replace(scene, system=system))
    solution = CompiledLocalGlobal().prepare(system).solve(stated, StopRule(iterations, rtol))
    assert solution.termination_reason != "max-iter", "the static solve has not converged"
    return solution.positions


def build_random_network(rng: np.random.Generator, n: int, m: int) -> tuple[Positions, Springs]:
    """Rest positions (n, 3) [m] and m springs of random stiffness between random vertices, loops and twins included."""
    rest = rng.normal(size=(n, 3))
    return rest, Springs.from_rest_shape(rest, rng.integers(0, n, (m, 2)), rng.uniform(1.0, 1e3, m))


def build_random_problem(
    seed: int, *, n: int = 12, m: int = 30, weights: tuple[float, ...] = (1e4, np.inf)
) -> StepProblem:
    """A step of a random network under random forces; vertices 0, 1, ... are pinned with the weights."""
    rng = np.random.default_rng(seed)
    rest, springs = build_random_network(rng, n, m)
    q = len(weights)
    system = System(rng.uniform(0.1, 2.0, n), 1 / 30, (springs,), DirichletPins(np.arange(q), np.array(weights)))
    targets = rest[:q] + 0.1 * rng.normal(size=(q, 3))
    target, force, guess = (rng.normal(size=(n, 3)) for _ in range(3))
    current = rest.copy()
    current[:q] = targets
    return StepProblem(system, target, force, targets, current, guess, build_step_start(system, target, current))


def build_step_start(system: System, target: Positions, current: Positions) -> StepStart:
    """The start of a step of implicit Euler from the current positions, by which inertia leads to the target."""
    dt = system.time_step
    return StepStart(current, (target - current) / dt, 0.0, current, 1.0 / dt)


def make_read_only(problem: StepProblem) -> StepProblem:
    """The same problem; writing to one of its arrays raises."""
    arrays = [
        problem.inertial_target,
        problem.external_force,
        problem.pin_targets,
        problem.current_positions,
        problem.initial_guess,
    ]
    for array in [*arrays, problem.system.mass, problem.system.pins.vertices, problem.system.pins.weight]:
        array.flags.writeable = False
    return problem


def rounding_scale(problem: StepProblem) -> float:
    """|e|_Q [J^(1/2)] of a displacement e by the largest coordinate at every unpinned vertex: the scale of rounding."""
    trace = float(assemble_stiffness(problem.system).diagonal()[problem.system.unpinned_mask].sum())
    return float(np.abs(problem.initial_guess).max(initial=0.0)) * trace**0.5


def join_problems(problem: StepProblem, other: StepProblem) -> StepProblem:
    """Two problems as one, whose components do not touch."""
    n, systems = problem.system.num_vertices, (problem.system, other.system)
    moved = [replace(e, edges=e.edges + n) for e in other.system.energies if isinstance(e, Springs | StrainLimits)]
    pins = [s.pins for s in systems]
    system = System(
        np.concatenate([s.mass for s in systems]),
        problem.system.time_step,
        (*problem.system.energies, *moved),
        DirichletPins(np.append(pins[0].vertices, pins[1].vertices + n), np.append(pins[0].weight, pins[1].weight)),
    )
    names = ("inertial_target", "external_force", "pin_targets", "current_positions", "initial_guess")
    arrays = {name: np.concatenate([getattr(problem, name), getattr(other, name)]) for name in names}
    return StepProblem(
        system, **arrays, step_start=build_step_start(system, arrays["current_positions"], arrays["current_positions"])
    )


def shift_problem(problem: StepProblem, offset: float, stiffness_factor: float = 1.0) -> StepProblem:
    """The problem elsewhere, and of stiffer springs."""
    names = ("inertial_target", "pin_targets", "current_positions", "initial_guess")
    energies = tuple(
        replace(e, stiffness=stiffness_factor * e.stiffness) for e in problem.system.energies if isinstance(e, Springs)
    )
    arrays = {name: getattr(problem, name) + offset for name in names}
    return replace(problem, system=replace(problem.system, energies=energies), **arrays)


def single_stage_integrator(scene: Scene) -> SingleStageIntegrator:
    """A scene's integrator, which solves for the positions at the step's end alone."""
    assert isinstance(scene.integrator, SingleStageIntegrator)
    return scene.integrator


THREAD_COUNT = min(len(os.sched_getaffinity(0)), int(os.environ.get("NUMBA_NUM_THREADS") or 1024))
"""How many Numba has: a query would start them, and a process in which they run is not forked."""
