"""The half-spaces of contact against geometry: they separate, meet the first contact, let pass what misses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.solvers.contact.half_space.half_space_potential import ConvexObstacle
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact as Energy
from springbench.solvers.model.step_problem import Positions, StepStart

from tests.contact_scenes import CONTACT_THICKNESS, OBSTACLE_SPECS, build_contact

CONTACT_RTOL = 1e-6
"""Relative: so near Newton's method comes to the first contact."""


def build_energy(effect: ContactEffect, n: int, stiffness: float = 100.0) -> Energy:
    obstacles = tuple(one.build_obstacle() for one in effect.obstacles)
    return Energy(obstacles, CONTACT_THICKNESS, effect.friction, np.full(n, stiffness), 1e-6, 0.1, 1.0)


def begin_step(energy: Energy, p: Positions, v: Positions, time: float = 0.0) -> Energy:
    return energy.begin_step(StepStart(p, v, time, p, 1.0, time + 1.0))


def sample_displacements(obstacle: ConvexObstacle, count: int = 400) -> tuple[Positions, Positions]:
    """Starts outside of an obstacle and velocities towards it and past it."""
    rng = np.random.default_rng(0)
    p = rng.uniform(-1.2, 1.2, (4 * count, 3))
    p = np.ascontiguousarray(p[obstacle.signed_distance(p, 0.0) > CONTACT_THICKNESS][:count])
    aim = rng.uniform((-0.6, -0.8, -0.5), (0.6, -0.2, 0.5), p.shape)
    return p, rng.uniform(0.3, 2.0, (len(p), 1)) * (aim - p)


def sample_least_distance(obstacle: ConvexObstacle, p: Positions, v: Positions) -> np.ndarray:
    """The least distance on the way, by many points."""
    return np.min([obstacle.signed_distance(p + s * v, 0.0) for s in np.linspace(0.0, 1.0, 2001)], axis=0)


@pytest.mark.parametrize("name", OBSTACLE_SPECS)
def test_a_half_space_has_the_start_on_its_outer_side_and_the_obstacle_on_the_other(name):
    energy = build_energy(build_contact(OBSTACLE_SPECS[name]), 400)
    (obstacle,) = energy.obstacles
    p, v = sample_displacements(obstacle)
    planes = begin_step(energy, p, v).active_planes
    assert len(planes.vertices) > 50
    outside = np.einsum("ij,ij->i", planes.normal, p[planes.vertices]) - planes.offset
    assert outside.min() >= -1e-12
    cloud = np.random.default_rng(1).uniform((-1, -1, -1), (1, 0, 1), (20_000, 3))
    inside = cloud[obstacle.signed_distance(cloud, 0.0) <= 0.0]
    assert len(inside) > 100
    beyond = planes.normal @ inside.T - planes.offset[:, None]
    assert beyond.max() <= -CONTACT_THICKNESS + 1e-12


@pytest.mark.parametrize("name", OBSTACLE_SPECS)
def test_vertices_that_miss_an_obstacle_are_free_and_those_that_hit_it_are_stopped(name):
    energy = build_energy(build_contact(OBSTACLE_SPECS[name]), 400)
    (obstacle,) = energy.obstacles
    p, v = sample_displacements(obstacle)
    planes = begin_step(energy, p, v).active_planes
    gap = np.full(len(p), np.inf)
    gap[planes.vertices] = np.einsum("ij,ij->i", planes.normal, (p + v)[planes.vertices]) - planes.offset
    least = sample_least_distance(obstacle, p, v)
    misses, hits = least > CONTACT_THICKNESS * (1 + 1e-3), least < CONTACT_THICKNESS * (1 - 1e-2)
    assert misses.sum() > 20
    assert hits.sum() > 20
    assert gap[misses].min() >= -1e-3 * CONTACT_THICKNESS  # Newton's method ends so near to the nearest point of a way
    assert gap[hits].max() < 0.0


@pytest.mark.parametrize("name", ["plane", "sphere", "capsule", "plate"])
def test_a_half_space_touches_the_first_contact_of_a_path(name):
    energy = build_energy(build_contact(OBSTACLE_SPECS[name]), 400)
    (obstacle,) = energy.obstacles
    p, v = sample_displacements(obstacle)
    planes = begin_step(energy, p, v).active_planes
    a, d = p[planes.vertices], v[planes.vertices]
    rate = np.einsum("ij,ij->i", planes.normal, d)
    hit = rate < -1e-3
    s = ((planes.offset - np.einsum("ij,ij->i", planes.normal, a)) / np.where(hit, rate, 1.0))[hit]
    crossed = (s <= 1.0) & (sample_least_distance(obstacle, a[hit], d[hit]) < 0.99 * CONTACT_THICKNESS)
    there = obstacle.signed_distance((a[hit] + s[:, None] * d[hit])[crossed], 0.0)
    assert crossed.sum() > 20
    # The stop's CONTACT_RTOL is relative to the radius with the thickness, 0.31 m at most.
    np.testing.assert_allclose(there, CONTACT_THICKNESS, rtol=0, atol=2 * CONTACT_RTOL * 0.31)


def test_nothing_near_is_idle_and_costs_no_half_space():
    energy = build_energy(build_contact(OBSTACLE_SPECS["sphere"], OBSTACLE_SPECS["capsule"]), 3)
    p = np.array([[5.0, 5.0, 5.0], [5.1, 5.0, 5.0], [5.0, 5.3, 5.0]])
    step = begin_step(energy, p, np.zeros_like(p))
    out = np.zeros_like(p)
    step.add_gradient(p, out)
    assert step.has_no_active_collisions()
    assert (step.value(p), float(np.abs(out).max()), step.hessian(p).nnz) == (0.0, 0.0, 0)
    assert not begin_step(energy, p, np.full_like(p, -5.0)).has_no_active_collisions()


@pytest.mark.parametrize("name", OBSTACLE_SPECS)
def test_gradient_and_hessian_are_differences_of_the_value(name):
    """At points that press, slip and stick; the energy is smooth but where one of them begins."""
    energy = build_energy(build_contact(OBSTACLE_SPECS[name], friction=0.5), 200)
    (obstacle,) = energy.obstacles
    p, _ = sample_displacements(obstacle, 200)
    rng = np.random.default_rng(2)
    step = begin_step(energy, p, rng.normal(size=p.shape))
    grip = np.where(np.arange(len(step.active_planes.vertices)) % 2, 3.0, 0.0)
    step = replace(step, active_planes=step.active_planes._replace(friction_limit=grip), smoothing_length=0.3)
    x, u, h = p + 0.5 * rng.normal(size=p.shape), rng.normal(size=p.shape), 1e-7
    step.add_gradient(x, gradient := np.zeros_like(x))
    found = (step.value(x + h * u) - step.value(x - h * u)) / (2 * h)
    # Round-off of a value of some hundred joules, divided by the step.
    assert found == pytest.approx(np.sum(gradient * u), rel=1e-6)
    ahead, behind = np.zeros_like(x), np.zeros_like(x)
    step.add_gradient(x + h * u, ahead)
    step.add_gradient(x - h * u, behind)
    change = (step.hessian(x) @ u.ravel()).reshape(x.shape)
    difference = (ahead - behind) / (2 * h)
    np.testing.assert_allclose(difference, change, rtol=0, atol=1e-5 * np.abs(change).max())


@pytest.mark.parametrize("name", OBSTACLE_SPECS)
def test_cautious_rows_majorise_the_energy(name):
    energy = build_energy(build_contact(OBSTACLE_SPECS[name], friction=0.5), 200)
    (obstacle,) = energy.obstacles
    p, _ = sample_displacements(obstacle, 200)
    rng = np.random.default_rng(3)
    step = begin_step(energy, p, rng.normal(size=p.shape))
    step = replace(
        step,
        active_planes=step.active_planes._replace(friction_limit=np.full(len(step.active_planes.vertices), 3.0)),
        smoothing_length=0.3,
    )
    for size in (0.01, 0.1, 1.0):
        x, d = p + 0.5 * rng.normal(size=p.shape), size * rng.normal(size=p.shape)
        rows = step.build_penalty_rows(x, x + d, majorise=True)
        step.add_gradient(x, gradient := np.zeros_like(x))
        along = np.einsum("ij,ij->i", rows.direction, d[rows.vertices])
        model = float(np.sum(gradient * d)) + 0.5 * float(rows.stiffness @ (along + rows.gap) ** 2)
        rise = step.value(x + d) - step.value(x)
        assert rise <= model + 1e-12 * abs(step.value(x))
