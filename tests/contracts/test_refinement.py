"""Under the continuum rule the same body hangs in the same shape at every mesh size, and the right one.

An elastic cable of unstretched length L, weight w a metre and stiffness EA, between two points of equal height
(Irvine 1981, section 1.5): with s the unstretched arc length, V = w L / 2 and H the horizontal tension,

    x(s) = H s / EA + H/w (asinh(V/H) - asinh((V - w s) / H))
    y(s) = -s / EA (V - w s / 2) - H/w (sqrt(1 + (V/H)^2) - sqrt(1 + ((V - w s) / H)^2))
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.solvers.model.step_problem import Positions

from tests.scene_builders import build_test_scene, compute_static_shape

G, MASS, LENGTH = 9.81, 1.5, 2.0


def elastic_catenary(ea: float, span: float, s: np.ndarray) -> np.ndarray:
    """x and y (2, ...) [m] of the cable at the unstretched arc lengths s [m]."""
    w = MASS * G / LENGTH
    V = w * LENGTH / 2

    def x(H: float, s):
        return H * s / ea + H / w * (np.arcsinh(V / H) - np.arcsinh((V - w * s) / H))

    H = float(brentq(lambda H: x(H, LENGTH) - span, 1e-6, ea + w))  # pyright: ignore[reportArgumentType]
    sag = H / w * (np.sqrt(1 + (V / H) ** 2) - np.sqrt(1 + ((V - w * s) / H) ** 2))
    return np.stack([x(H, s), -s / ea * (V - w * s / 2) - sag])


def hanging_chain(ea: float, span: float, size: int) -> Positions:
    """A chain whose ends are pinned `span` apart, at rest."""
    made = build_test_scene(
        ChainMesh(length=LENGTH),
        SpringsEffect(stretch=ea),
        GravityEffect(),
        PinsEffect(parts=("ends",), weight="exact"),
        size=size,
        mass=MASS,
    )
    targets = made.pin_targets.copy()
    targets[1, 0] = span
    return compute_static_shape(replace(made, pin_targets=targets))


CHAINS = [(20.0, 2.0), (100.0, 2.0), (100.0, 2.6), (50.0, 1.2), (300.0, 1.6)]
"""EA [N] and span [m] of a cable of 2 m: taut, stretched, slack."""


@pytest.mark.parametrize(("ea", "span"), CHAINS)
def test_a_hanging_chain_takes_the_shape_of_the_elastic_catenary(ea, span):
    errors = []
    for size in (9, 17, 33):
        expected = elastic_catenary(ea, span, np.linspace(0, LENGTH, size))
        errors.append(np.abs(hanging_chain(ea, span, size)[:, :2].T - expected).max())
    # A chain of links is the midpoint rule for the cable's integrals: the error falls as h^2, by 4 a halving;
    # the next term, of h^4, still shows in the coarsest chain.
    assert errors[-1] < 1e-3 * LENGTH
    assert 3.5 < errors[0] / errors[1] < 4.6
    assert 3.8 < errors[1] / errors[2] < 4.2


def sag(size: int, **stiffness: float) -> float:
    """How far the middle of a level cloth, pinned all around, hangs down [m]."""
    pins = PinsEffect(parts=("boundary",), weight="exact")
    made = build_test_scene(
        GridMesh(bend_springs=True), SpringsEffect.model_validate(stiffness), GravityEffect(), pins, size=size, mass=0.5
    )
    p = compute_static_shape(made)
    return -p[len(p) // 2, 1]


@pytest.mark.parametrize("bend", [0.0, 1e-3])
@pytest.mark.parametrize("shear", [0.0, 30.0, 100.0])
def test_a_cloth_hangs_in_the_same_shape_at_every_size(shear, bend):
    found = [sag(size, stretch=100.0, shear=shear, bend=bend) for size in (5, 9, 17)]
    # Second order as for the chain; the corners, where the strain is not smooth, take away a part of it.
    assert abs(found[2] - found[1]) < 0.4 * abs(found[1] - found[0])
    assert abs(found[2] - found[1]) < 0.01 * found[2]
