"""Check of energies from user code: gradients are compared with derivatives of the values.

    f'(x).d = Im f(x + i h d) / h                           complex step (Squire and Trapp 1998): no cancellation
    f'(x).d = (4 D(h/2) - D(h)) / 3                         central differences D, Richardson-extrapolated

The differences are used where the value does not support complex positions or is not an analytic function; the
difference of D(h/2) and D(h) bounds their error. The check shows that a gradient belongs to its value; it cannot show
that the value is the intended formula. Energies of springbench are not checked at run time: its tests compare them with
independently written formulas.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state
from springbench.solvers.model.rounding_bound import EPS
from springbench.solvers.model.step_problem import Energy, Positions, StepStart, System, is_lagged
from springbench.solvers.plugins.file_modules import is_file_module

NUM_POINTS = 20
SPACING_FRACTIONS = (1e-3, 1e-2, 0.1, 0.5)
"""Deviations of the points from the start or the rest positions, relative to the mesh spacing."""
ROUNDOFF_MULTIPLE = 200.0
"""Number of roundings in an element's energy, with a margin for sums of thousands of elements."""
_COMPLEX_STEP = 1e-100
"""h [m] of the complex step; its truncation error, of order h^2, is far below round-off."""
_DIFFERENCE_STEP = 1e-4
"""h of the central differences, relative to the smallest length."""


class _SamplePoint(NamedTuple):
    """Start of a step, a point x (n, 3) [m] and a direction (n, 3)."""

    start: StepStart
    x: Positions
    direction: NDArray[np.float64]


def measure_gradient_errors(scene: Scene, frames: int) -> dict[str, float]:
    """Measure the gradient errors of a scene's energies from user code.

    Each energy is evaluated at random points, with a fixed seed.

    Args:
        scene: scene of the run.
        frames: number of frames; the points lie at times of these.

    Returns:
        Largest relative error by class name of the energy; 0 within round-off.
    """
    errors, min_length = dict[str, float](), _find_min_length(scene)
    if all(map(_is_shipped, scene.system.energies)):
        return errors
    with np.errstate(all="ignore"):  # values that are not finite are left out
        for system, point in _sample_points(scene, frames):
            for energy in (one for one in system.energies if not _is_shipped(one)):
                begun = energy.begin_step(point.start) if is_lagged(energy) else energy
                start = point.start.positions, point.start.velocity_origin
                scale = max(float(np.abs(part).max(initial=0.0)) for part in (point.x, *start))
                error = measure_gradient_error(begun, point.x, point.direction, scale, min_length)
                name = type(energy).__name__
                errors[name] = max(errors.get(name, 0.0), error)
    return errors


def _find_min_length(scene: Scene) -> float:
    """Return the smallest rest length [m] of a spring, or the mesh spacing without springs."""
    lengths = scene.mesh.rest_lengths
    return float(lengths[lengths > 0.0].min(initial=scene.mesh.spacing))


def _is_shipped(energy: Energy) -> bool:
    module = type(energy).__module__
    return module.startswith("springbench.") and not is_file_module(module)


def _sample_points(scene: Scene, frames: int) -> Iterator[tuple[System, _SamplePoint]]:
    """Yield points near the start and near the rest positions, each with its system.

    Every fifth point is in the first frame.
    """
    rng, rest = np.random.default_rng(0), scene.mesh.rest_positions
    begun = build_initial_state(scene).motion
    for k in range(NUM_POINTS):
        index = 0 if k % 5 == 0 else int(rng.integers(1, max(2, frames)))
        system, time = scene.find_step_scene(index).system, scene.compute_time(index)
        size = SPACING_FRACTIONS[k % len(SPACING_FRACTIONS)] * scene.mesh.spacing
        origin = begun.positions if k // len(SPACING_FRACTIONS) % 2 == 0 else rest
        p, v, x, velocity_origin = (size * rng.normal(size=rest.shape) for _ in range(4))
        p, v = origin + p, begun.velocity + v / system.time_step
        direction = np.zeros_like(rest)
        direction[system.free_vertices] = rng.normal(size=(len(system.free_vertices), 3))
        start = StepStart(p, v, time, p + velocity_origin, system.velocity_rate, time + system.time_step)
        yield system, _SamplePoint(start, p + system.time_step * v + x, direction)


def measure_gradient_error(
    energy: Energy, x: Positions, direction: NDArray[np.float64], coordinate_scale: float, min_length: float
) -> float:
    """Return the relative error of the directional derivative that an energy's gradient gives.

    Args:
        energy: energy of a step.
        x: positions (n, 3) [m].
        direction: direction (n, 3).
        coordinate_scale: largest coordinate [m] that the energy depends on.
        min_length: smallest length [m] that it depends on.

    Returns:
        Error relative to the derivative of its value; 0 within round-off, inf if it is not finite.
    """
    gradient = np.zeros_like(x)
    energy.add_gradient(x, gradient)
    slope, size = float((gradient * direction).sum()), float(np.abs(gradient * direction).sum())
    tolerance = ROUNDOFF_MULTIPLE * EPS * (1.0 + coordinate_scale / min_length) * size
    if abs(_complex_step_derivative(energy, x, direction) - slope) <= tolerance or not np.isfinite(energy.value(x)):
        return 0.0
    h = _DIFFERENCE_STEP * min_length
    derivative, bound = _difference_derivative(energy, x, direction, h, coordinate_scale)
    difference = abs(derivative - slope)
    if difference <= bound + tolerance:
        return 0.0
    error = difference / max(abs(derivative), size, np.finfo(float).tiny)
    return error if np.isfinite(error) else float("inf")


def _complex_step_derivative(energy: Any, x: Positions, direction: NDArray[np.float64]) -> float:
    """Return the derivative of the value by a complex step.

    The result is nan if the value does not support complex positions.
    """
    try:
        with warnings.catch_warnings(action="error", category=np.exceptions.ComplexWarning):
            return complex(energy.value(x + 1j * _COMPLEX_STEP * direction)).imag / _COMPLEX_STEP
    except Exception:  # user code for real positions may fail with any exception
        return float("nan")


def _difference_derivative(
    energy: Energy, x: Positions, direction: NDArray[np.float64], h: float, coordinate_scale: float
) -> tuple[float, float]:
    """Return the derivative of the value by central differences (step h [m]) and an error bound."""
    values = [float(energy.value(x + s * h * direction)) for s in (-1.0, -0.5, 0.5, 1.0)]
    coarse, fine = (values[3] - values[0]) / (2 * h), (values[2] - values[1]) / h
    roundoff = max(map(abs, values)) / h + coordinate_scale / h * abs(fine)
    return (4 * fine - coarse) / 3, abs(coarse - fine) + ROUNDOFF_MULTIPLE * EPS * roundoff
