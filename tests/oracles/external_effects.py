"""Terms of effects from user code: their own forces, filters, pins and energies.

They have no reference implementation. With them the reference step is complete, so that the shipped effects of the
scene can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from springbench.harness.scenes.effects.effect_interface import EffectContribution, PinGroup
from springbench.solvers.model.step_problem import Energy, ProjectiveEnergy, StepStart, is_lagged

from tests.oracles import per_vertex_terms
from tests.oracles.complex_step import EPS, ROUNDOFF_MULTIPLE, DirectionalDerivatives, to_extended
from tests.oracles.scene_declaration import Array, EffectTerms


def build_external_effect(contribution: EffectContribution) -> EffectTerms:
    """Build the terms of an effect from its own forces, filters and pins."""

    def force(p: Array, v: Array, t: float) -> tuple[Array, float]:
        parts = [np.asarray(one(p, v, t)) for one in contribution.forces]
        return sum(parts, np.zeros_like(p)), sum(float(np.abs(part).max()) for part in parts)

    def decay(v: Array) -> Array:
        for one in contribution.velocity_filters:
            v = one(v)
        return v

    pinned = {
        i: per_vertex_terms.build_pin(pin.weight, pin.motion, q)
        for pin in contribution.pins
        for i, q in _list_pins(pin)
    }
    return EffectTerms(
        evaluate_force=force if contribution.forces else None,
        filter_velocity=decay if contribution.velocity_filters else None,
        pinned_vertices=pinned,
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


def read_own_derivatives(energies: Sequence[Energy], x: Array, d: Array) -> DirectionalDerivatives:
    """Return the sums of the energies' own values and slopes at x along d, both (n, 3), with round-off as tolerance."""
    values, slopes = list[float](), list[float]()
    for energy in energies:
        gradient = np.zeros_like(x)
        energy.add_gradient(x, gradient)
        values.append(float(energy.value(x)))
        slopes.append(float((gradient * d).sum()))
    roundoff = ROUNDOFF_MULTIPLE * EPS
    tolerances = roundoff * sum(map(abs, values)), roundoff * sum(map(abs, slopes)), 0.0
    return DirectionalDerivatives(sum(values), sum(slopes), 0.0, tolerances)
