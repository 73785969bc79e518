"""Checks of effects without a reference implementation: their gradients against their own values.

The gradient of an energy is compared with complex steps of its own value. Where the value does not support complex
numbers, or is not an analytic function, it is compared with central differences at two step sizes, whose difference
estimates their error.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from springbench.harness.scenes.effects.effect_interface import EffectContribution, PinGroup
from springbench.solvers.model.step_problem import Energy, ProjectiveEnergy, StepStart, is_lagged

from tests.oracles import per_vertex_terms
from tests.oracles.complex_step import EPS, ROUNDOFF_MULTIPLE, DirectionalDerivatives, to_extended
from tests.oracles.scene_declaration import Array, EffectTerms

_COMPLEX_STEP = 1e-100


def build_external_effect(bound: EffectContribution) -> EffectTerms:
    """Build the terms of an effect from its own forces, filters and pins."""

    def force(p: Array, v: Array, t: float) -> tuple[Array, float]:
        parts = [np.asarray(one(p, v, t)) for one in bound.forces]
        return sum(parts, np.zeros_like(p)), sum(float(np.abs(part).max()) for part in parts)

    def decay(v: Array) -> Array:
        for one in bound.velocity_filters:
            v = one(v)
        return v

    held = {i: per_vertex_terms.build_pin(pin.weight, pin.motion, q) for pin in bound.pins for i, q in _list_pins(pin)}
    return EffectTerms(
        evaluate_force=force if bound.forces else None,
        filter_velocity=decay if bound.velocity_filters else None,
        pinned_vertices=held,
    )


def _list_pins(pin: PinGroup) -> list[tuple[int, Any]]:
    return list(zip(pin.vertices.tolist(), to_extended(pin.targets), strict=True))


def sum_diagonals(energies: Sequence[Energy], n: int, time_step: float) -> Array:
    """Sum the energies' shares of the diagonal of Q (n,) [N/m].

    Args:
      energies: energies of the effect.
      n: number of vertices.
      time_step: step size dt [s]; the shares are those at the rate 1/dt.
    """
    zero, total = np.zeros((n, 3)), np.zeros(n)
    start = StepStart(zero, zero, 0.0, zero, 1.0 / time_step, 0.0)
    for energy in energies:
        begun = energy.begin_step(start) if is_lagged(energy) else energy
        if isinstance(begun, ProjectiveEnergy):
            total += begun.stiffness_matrix(n).diagonal()
    return total


def check_own_gradient(
    own: Sequence[Energy], x: Array, d: Array, reach: float, shortest: float
) -> tuple[DirectionalDerivatives, float | None]:
    """Compare the gradients of energies along d with derivatives of their own values.

    Args:
      own: energies.
      x: positions (n, 3) [m].
      d: direction (n, 3).
      reach: largest coordinate [m].
      shortest: smallest length [m].

    Returns: values and slopes along d, and the largest relative error of a gradient, None where all are correct.
    """
    values, slopes = list[float](), list[float]()
    wrong: float | None = None
    for energy in own:
        gradient = np.zeros_like(x)
        energy.add_gradient(x, gradient)
        value, slope = float(energy.value(x)), float((gradient * d).sum())
        size = float(np.abs(gradient * d).sum())
        if not (_matches_complex_step(energy, x, d, slope, size, reach / shortest) or not np.isfinite(value)):
            found, room = _difference_derivative(energy, x, d, 1e-4 * shortest, reach)
            if not abs(found - slope) <= room + ROUNDOFF_MULTIPLE * EPS * (1.0 + reach / shortest) * size:
                wrong = max(wrong or 0.0, abs(found - slope) / max(abs(found), size, np.finfo(float).tiny))
        values.append(value)
        slopes.append(slope)
    rounded = ROUNDOFF_MULTIPLE * EPS
    room = rounded * sum(map(abs, values)), rounded * sum(map(abs, slopes)), 0.0
    return DirectionalDerivatives(sum(values), sum(slopes), 0.0, room), wrong


def _matches_complex_step(energy: Any, x: Array, d: Array, slope: float, size: float, far: float) -> bool:
    """Return whether the derivative of the energy's value by a complex step equals the slope."""
    try:
        with warnings.catch_warnings(action="error", category=np.exceptions.ComplexWarning):
            found = complex(energy.value(x + 1j * _COMPLEX_STEP * d)).imag / _COMPLEX_STEP
    except Exception:  # it is made for real numbers, and may say so in any way
        return False
    return bool(abs(found - slope) <= ROUNDOFF_MULTIPLE * EPS * (1.0 + far) * size)


def _difference_derivative(energy: Any, x: Array, d: Array, h: float, reach: float) -> tuple[float, float]:
    """Return the derivative by Richardson-extrapolated central differences of step h [m], and its error bound."""
    values = [float(energy.value(x + s * h * d)) for s in (-1.0, -0.5, 0.5, 1.0)]
    rough, fine = (values[3] - values[0]) / (2 * h), (values[2] - values[1]) / h
    room = abs(rough - fine) + ROUNDOFF_MULTIPLE * EPS * (max(map(abs, values)) / h + reach / h * abs(fine))
    return (4 * fine - rough) / 3, room
