"""Verification of a scene: its steps agree with an independent reference implementation at random points.

At each point the harness builds one step and takes it, with a solver that returns the point. The comparison covers the
masses, the inertia and its target, the forces, the pins, and the motion after the step. It also covers the energy of
each effect, its gradient and its Hessian along a random direction, and the objective, the sum of all terms. An
effect from user code has no reference implementation; its own terms are used in both steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.time_loop import simulate_scene
from springbench.solvers.model.step_problem import Solution, StepProblem, StopRule

from tests.oracles.compare_terms import (
    ComparisonPoint,
    TermMismatch,
    compare_arrays,
    compare_energies,
    compare_steps,
    with_friction_at,
)
from tests.oracles.sample_points import SamplePoint, sample_points
from tests.oracles.scene_declaration import Array
from tests.oracles.scene_terms import SceneTerms, build_scene_terms
from tests.oracles.stage_terms import STAGED_INTEGRATORS, solve_stages
from tests.oracles.step_terms import build_reference_step

MATCH, MISMATCH, NO_REFERENCE = "agrees", "disagrees", "agrees without"


def verify_terms(spec: SceneSpec, scene: Scene, integrator: str) -> str:
    """Compare a scene's terms with the reference implementation.

    Args:
      spec: specification of the scene.
      scene: scene built from it with the integrator.
      integrator: name of the integrator.

    Returns: `agrees`; `disagrees: term, by relative difference; ...`; or `agrees without: effects` where these effects
      have no reference implementation.
    """
    with np.errstate(all="ignore"):  # what is not finite is compared like all else
        sides = [build_scene_terms(spec, scene)]
        if scene.alternate_scene:
            sides.append(
                build_scene_terms(spec.with_time_step(scene.alternate_scene.system.time_step), scene.alternate_scene)
            )
        found: dict[str, float] = {}
        for point in sample_points(scene, sides[0].declaration, spec.frames):
            for finding in _compare_single_stage(sides, scene, integrator, point):
                found[finding.name] = max(finding.relative_difference, found.get(finding.name, 0.0))
    if found:
        worst = sorted(found.items(), key=lambda item: -item[1])
        return f"{MISMATCH}: " + "; ".join(f"{name}, by {by:.2g} of its size" for name, by in worst)
    external = ", ".join(sides[0].format_effect_name(k) for k in sorted(sides[0].external_effects))
    return f"{NO_REFERENCE}: {external}" if external else MATCH


class _FixedSolution:
    """Substitute for a prepared solver, with a given solution.

    Its solution is x (n, 3) [m] as a function of the time [s]. It returns the velocity at the step's end if
    `with_velocity`.
    """

    def __init__(self, x: Callable[[float], Array], *, with_velocity: bool = False) -> None:
        self.x, self._moves = x, with_velocity

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        """Return the given solution of any step."""
        x = self.x(problem.step_start.stage_time)
        v = problem.step_start.velocity_at(x) if self._moves else None
        return Solution(x, 0, float("nan"), float("nan"), "max-iter", v)


def _compare_single_stage(
    sides: list[SceneTerms], scene: Scene, integrator: str, point: SamplePoint
) -> Iterator[TermMismatch]:
    """Compare all terms at one point."""
    index, now, before = point.state.index, point.state.motion, point.state.previous_motion
    own = sides[index % len(sides)]
    time = sum(sides[k % len(sides)].declaration.time_step for k in range(len(sides))) * (index // len(sides))
    time += sides[0].declaration.time_step * (index % len(sides))
    if integrator in STAGED_INTEGRATORS:
        yield from _compare_stages(own, scene, integrator, point, time)
        return
    reference_step = build_reference_step(integrator, own.declaration, own.effect_terms, now, before, time)
    m = reference_step.step_moment
    x = np.asarray(m.p + m.stage_fraction * m.time_step * m.v, float) + point.shift
    answer: Any = _FixedSolution(lambda until: x, with_velocity=integrator == "substepping")
    run = simulate_scene(
        scene, answer, StopRule(), initial_guess="previous", frames=index + 1, initial_state=point.state
    )
    done = next(run)
    at = ComparisonPoint(own, with_friction_at(reference_step, done.problem, x), done.problem, x, point.direction)
    yield from compare_steps(at)
    p, v = reference_step.end_motion(x)
    after = done.state
    yield from compare_arrays("positions after the step", after.motion.positions, p, at.coordinate_scale)
    yield from compare_arrays(
        "velocities after the step", after.motion.velocity, v, m.velocity_rate * at.coordinate_scale
    )
    if after.previous_motion is None:
        yield TermMismatch("the motion before (number)", 1.0)
    else:
        yield from compare_arrays("positions before", after.previous_motion.positions, m.p, at.coordinate_scale)
        yield from compare_arrays(
            "velocities before", after.previous_motion.velocity, m.v, at.coordinate_scale / m.time_step
        )
    yield from compare_energies(at)


def _compare_stages(
    own: SceneTerms, scene: Scene, integrator: str, point: SamplePoint, time: float
) -> Iterator[TermMismatch]:
    """Compare all terms of an integrator with several stages, solved by extrapolation."""
    now, dt = point.state.motion, own.declaration.time_step

    def x(until: float) -> Array:
        return np.asarray(now.positions + (until - time) * now.velocity + (until - time) / dt * point.shift, float)

    a = point.state.acceleration
    assert a is not None
    expected = solve_stages(integrator, own.declaration, own.effect_terms, now, a, time, x)
    answer: Any = _FixedSolution(x)
    index = point.state.index
    done = next(
        simulate_scene(scene, answer, StopRule(), initial_guess="previous", frames=index + 1, initial_state=point.state)
    )
    if len(done.stages) != len(expected.reference_steps):
        yield TermMismatch("unknowns of the step (number)", 1.0)
        return
    scale = 0.0
    for (problem, _), reference_step, answered in zip(
        done.stages, expected.reference_steps, expected.answers, strict=True
    ):
        at = ComparisonPoint(
            own, with_friction_at(reference_step, problem, answered), problem, answered, point.direction
        )
        scale = max(scale, at.coordinate_scale)
        yield from compare_steps(at)
        yield from compare_energies(at)
    rate = expected.reference_steps[0].step_moment.velocity_rate
    assert done.state.acceleration is not None
    for name, ours, theirs, size in (
        ("positions after the step", done.state.motion.positions, expected.end[0], scale),
        ("velocities after the step", done.state.motion.velocity, expected.end[1], rate * scale),
        ("acceleration after the step", done.state.acceleration, expected.acceleration, rate**2 * scale),
    ):
        yield from compare_arrays(name, ours, theirs, size)
