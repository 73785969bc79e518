"""Comparison of the two implementations of a scene's terms at one point.

Arrays may differ by the round-off of the sums they result from; energies and their derivatives as `complex_step`
states.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from springbench.solvers.model.step_problem import Energy, StepProblem

from tests.oracles.complex_step import (
    EPS,
    ROUNDOFF_MULTIPLE,
    DirectionalDerivatives,
    differentiate_along,
    to_extended,
)
from tests.oracles.external_effects import read_own_derivatives
from tests.oracles.key_frame_motion import bound_roundoff
from tests.oracles.scene_declaration import Array
from tests.oracles.scene_terms import SceneTerms
from tests.oracles.step_terms import ReferenceStep

_SETTLED_SLOPE_SHARE = 1e-3
"""Relative change of a slope allowed by friction's normal forces once the friction rounds have ended."""


class TermMismatch(NamedTuple):
    """Name of a term that differs, and the difference relative to the reference value."""

    name: str
    relative_difference: float


@dataclass(frozen=True, eq=False)
class ComparisonPoint:
    """A point of comparison.

    Attributes:
      scene_terms: reference terms of the scene.
      reference_step: the step as the reference implementation builds it.
      problem: the step as the harness builds it.
      x: solution of the step (n, 3) [m].
      direction: direction of the derivatives (n, 3).
    """

    scene_terms: SceneTerms
    reference_step: ReferenceStep
    problem: StepProblem
    x: Array
    direction: Array

    @property
    def coordinate_scale(self) -> float:
        """The largest coordinate [m] that the step depends on."""
        m = self.reference_step.step_moment
        parts = (self.x, m.p, m.velocity_origin, m.time_step * m.v, self.reference_step.inertial_target)
        return max(float(np.abs(part).max(initial=0.0)) for part in parts)

    @property
    def pin_target_scale(self) -> float:
        """The size [m] whose product with eps is the round-off of the pins' targets."""
        size = self.coordinate_scale + sum(terms.coordinate_scale for terms in self.scene_terms.effect_terms)
        moves = [
            motion for effect in self.scene_terms.declaration.effects if (motion := getattr(effect, "motion", None))
        ]
        end = self.reference_step.step_moment.time + self.reference_step.step_moment.time_step
        # A mesh may lie in one point and its pin targets elsewhere.
        target_scale = float(np.abs(self.reference_step.pin_targets).max(initial=0.0))
        return max([size, target_scale, *(bound_roundoff(motion, size, end) / EPS for motion in moves)])


def with_friction_at(step: ReferenceStep, problem: StepProblem, x: Array) -> ReferenceStep:
    """Return the step with friction's normal forces at its solution x (n, 3) [m].

    It is unchanged unless the harness has a further friction round.
    """
    return (
        step
        if problem.step_start.normal_force_positions is None
        else replace(step, step_moment=replace(step.step_moment, normal_force_positions=to_extended(x)))
    )


def compare_arrays(name: str, ours: Any, theirs: Any, size: float) -> Iterator[TermMismatch]:
    """Compare arrays and yield a mismatch if they differ by more than round-off.

    Args:
      name: name of the term.
      ours: array of the harness.
      theirs: array of the reference implementation.
      size: magnitude [unit of the arrays] of the numbers that determine the round-off.
    """
    ours, theirs = to_extended(ours), to_extended(theirs)
    if ours.shape != theirs.shape:
        yield TermMismatch(f"{name} (number)", 1.0)
        return
    difference = float(np.where(ours == theirs, 0.0, np.abs(ours - theirs)).max(initial=0.0))
    if not difference <= ROUNDOFF_MULTIPLE * EPS * size:
        yield TermMismatch(name, _relative_size(difference, float(np.abs(theirs).max(initial=0.0))))


def _relative_size(difference: float, size: float) -> float:
    return difference / max(size, np.finfo(float).tiny)


def compare_steps(at: ComparisonPoint) -> Iterator[TermMismatch]:
    """Compare masses, inertia, forces and pins."""
    system, problem, step = at.problem.system, at.problem, at.reference_step
    m, start, mass, scale = (
        step.step_moment,
        at.problem.step_start,
        at.scene_terms.declaration.mass,
        at.coordinate_scale,
    )
    dt, most = m.time_step, float(np.abs(mass).max(initial=0.0))
    yield from compare_arrays("masses", system.mass, mass, most)
    yield from compare_arrays("inertia", system.inertia_diagonal, step.c * mass / dt**2, step.c * most / dt**2)
    yield from compare_arrays("inertial target", problem.inertial_target, step.inertial_target, scale)
    yield from compare_arrays("the step's start", start.positions, m.p, scale)
    yield from compare_arrays("filtered velocities", start.velocity, m.v, scale / dt)
    yield from compare_arrays("origin of velocities", start.velocity_origin, m.velocity_origin, scale)
    yield from compare_arrays(
        "rate of velocities",
        [start.velocity_rate, system.velocity_rate],
        [m.velocity_rate, m.velocity_rate],
        m.velocity_rate,
    )
    if start.normal_force_positions is not None:
        yield from compare_arrays(
            "where friction is pressed", start.normal_force_positions, m.normal_force_positions, scale
        )
    yield from compare_arrays("times", [start.time, start.stage_time], [m.time, m.stage_time], max(m.stage_time, dt))
    yield from compare_arrays(
        "forces",
        problem.external_force,
        step.external_force,
        step.force_size * (1.0 + scale / at.scene_terms.min_length()),
    )
    if system.pins.vertices.tolist() != step.vertices:
        yield TermMismatch("pinned vertices", 1.0)
        return
    soft = max((w for w in step.weights if np.isfinite(w)), default=0.0)
    found = sorted(
        (*edge, low, high)
        for one in system.length_constraints
        for edge, low, high in zip(one.edges.tolist(), one.min_length.tolist(), one.max_length.tolist(), strict=True)
    )
    expected = sorted(
        (*edge, *limits) for one in at.scene_terms.effect_terms for edge, limits in one.exact_lengths.items()
    )
    yield from compare_arrays("exact lengths", np.reshape(found, (-1, 4)), np.reshape(expected, (-1, 4)), scale)
    yield from compare_arrays("weights of pins", system.pins.weight, step.weights, soft)
    yield from compare_arrays("targets of pins", problem.pin_targets, step.pin_targets, at.pin_target_scale)


def compare_energies(at: ComparisonPoint) -> Iterator[TermMismatch]:
    """Compare the energies of each effect, and the objective, their sum."""
    scene_terms, step, scale = at.scene_terms, at.reference_step, at.coordinate_scale
    free = at.direction.copy()
    free[[i for i, w in zip(step.vertices, step.weights, strict=True) if np.isinf(w)]] = 0.0
    x, d = to_extended(at.x), to_extended(free)
    parts = [_evaluate_other_terms(at, x, d)]
    for k, begin in enumerate(scene_terms.energy_builders):
        own = [at.problem.energies[i] for i in scene_terms.energy_indices[k]]
        if begin is None:
            reference = read_own_derivatives(own, at.x, free)
        else:
            reference = differentiate_along(
                begin(step.step_moment), x, d, _effect_scale(at, k), scene_terms.min_length(k)
            )
            yield from _compare_lagged_friction(at, k, reference, x, d)
            if np.isfinite(reference.value) or any(np.isfinite(energy.value(at.x)) for energy in own):
                yield from _compare_effect(scene_terms.format_effect_name(k), reference, own, at.x, free)
        parts.append(reference)
    if not all(np.isfinite(part.value) for part in parts):
        return
    # Forces are computed in float64, with a separate sum for each vertex.
    pulled = ROUNDOFF_MULTIPLE * EPS * float(np.abs(d).sum()) * step.force_size
    tolerances = [sum(part.tolerances[k] for part in parts) for k in range(2)]
    value, slope = at.problem.value(at.x), float((at.problem.gradient(at.x) * free).sum())
    yield from _compare_values(
        "objective (value)", value, sum(part.value for part in parts), tolerances[0] + scale * pulled
    )
    yield from _compare_values("objective (gradient)", slope, sum(part.slope for part in parts), tolerances[1] + pulled)


def _compare_lagged_friction(
    at: ComparisonPoint, k: int, reference: DirectionalDerivatives, x: Any, d: Any
) -> Iterator[TermMismatch]:
    """Compare friction of effect k with normal forces at the step's start and at x."""
    effect, m, begin = (
        at.scene_terms.declaration.effects[k],
        at.reference_step.step_moment,
        at.scene_terms.energy_builders[k],
    )
    if m.normal_force_positions is not None or not getattr(effect, "friction", 0.0) or effect.friction_iterations == 1:
        return
    assert begin
    own = differentiate_along(
        begin(replace(m, normal_force_positions=x)), x, d, _effect_scale(at, k), at.scene_terms.min_length(k)
    )
    if (
        not abs(own.slope - reference.slope)
        <= _SETTLED_SLOPE_SHARE * abs(own.slope) + own.tolerances[1] + reference.tolerances[1]
    ):
        yield TermMismatch(
            f"{at.scene_terms.format_effect_name(k)} (friction's pressure)",
            _relative_size(abs(own.slope - reference.slope), abs(own.slope)),
        )


def _effect_scale(at: ComparisonPoint, k: int) -> float:
    """Return the largest coordinate [m] that effect k depends on, including moving parts."""
    effect, scale = (
        at.scene_terms.declaration.effects[k],
        at.coordinate_scale + at.scene_terms.effect_terms[k].coordinate_scale,
    )
    moving = [effect, *getattr(effect, "obstacles", ())]
    late = at.reference_step.step_moment.time + at.reference_step.step_moment.time_step
    return max([scale, *(bound_roundoff(getattr(one, "motion", None), scale, late) / EPS for one in moving)])


def _compare_effect(
    name: str, reference: DirectionalDerivatives, own: Sequence[Energy], x: Array, d: Array
) -> Iterator[TermMismatch]:
    """Compare the energies of one effect with its reference derivatives."""
    gradient = np.zeros_like(x)
    for energy in own:
        energy.add_gradient(x, gradient)
    yield from _compare_values(
        f"{name} (value)", sum(energy.value(x) for energy in own), reference.value, reference.tolerances[0]
    )
    yield from _compare_values(
        f"{name} (gradient)", float((gradient * d).sum()), reference.slope, reference.tolerances[1]
    )
    bend = sum(_second_derivative(energy, x, d) for energy in own)
    yield from _compare_values(f"{name} (Hessian)", bend, reference.curvature, reference.tolerances[2])


def _second_derivative(energy: Any, x: Array, d: Array) -> float:
    """Return the second derivative along d by an energy's Hessian.

    The Hessian may be split into a sparse part and columns.
    """
    flat = d.ravel()
    if not hasattr(energy, "low_rank_columns"):
        return float(flat @ (energy.hessian(x) @ flat))
    dense = np.einsum("nik,ni->k", energy.low_rank_columns(x), d)
    return float(flat @ (energy.sparse_hessian(x) @ flat) + dense @ dense)


def _compare_values(name: str, ours: float, theirs: float, tolerances: float) -> Iterator[TermMismatch]:
    if not abs(ours - theirs) <= tolerances:
        yield TermMismatch(name, _relative_size(abs(ours - theirs), abs(theirs)))


def _evaluate_other_terms(at: ComparisonPoint, x: Any, d: Any) -> DirectionalDerivatives:
    """Evaluate inertia, the pins' penalties and the forces."""
    step = at.reference_step
    soft = [i for i, w in enumerate(step.weights) if np.isfinite(w)]
    at_vertices, weight = [step.vertices[i] for i in soft], to_extended([step.weights[i] for i in soft])
    inertia = to_extended(step.c * at.scene_terms.declaration.mass / step.step_moment.time_step**2)

    def values(y: Any) -> Any:
        difference, sag = y - to_extended(step.inertial_target), y[at_vertices] - step.pin_targets[soft]
        squares = [inertia / 2 * (difference**2).sum(axis=1), weight / 2 * (sag**2).sum(axis=1)]
        return np.concatenate([*squares, -(y * step.external_force).sum(axis=1)])

    return differentiate_along(values, x, d, max(at.coordinate_scale, at.pin_target_scale), at.coordinate_scale or 1.0)
