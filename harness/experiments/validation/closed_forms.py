# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# SciPy's and NumPy's stubs leave the types of some results unknown.
"""Cases with a closed form: simulated values on a series of refinements, and exact ones.

free fall            y = -g t^2/2
pendulum             angle by Jacobi's elliptic functions: sin(a/2) = k cd(sqrt(g/l) t, k), k = sin(a0/2)
damped oscillator    x = e^(-d t) (cos w t + d/w sin w t), d = c/2m, w^2 = k/m - d^2
catenaries           Irvine, Cable Structures (1981), sections 1.2 and 1.3
hanging chain        elongation W L/(2 EA)
clamped cantilever   elastica under its weight, B theta'' = -w (L - s) cos theta
hinged cantilever    hangs straight down, L + w L^2/(2 K), K the membrane stiffness of the strip
slope                s = (sin a - mu cos a) g t^2/2; sticks for mu > tan a
membrane             centre of a square membrane: 0.07367135 p a^2/T (Timoshenko and Goodier, section 107)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from springbench.harness.experiments.validation.validation_scenes import (
    GRAVITY,
    REST_STEP,
    build_sheet,
    build_validation_scene,
    simulate_to_rest,
    simulate_to_time,
)
from springbench.harness.scenes.effects.bending_effect import BendingEffect
from springbench.harness.scenes.effects.constant_force_effect import ConstantForceEffect
from springbench.harness.scenes.effects.contact_effect import ContactEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.mesh_topology import build_offset_pairs
from springbench.harness.scenes.mesh.network_mesh import NetworkMesh
from springbench.solvers.model.step_problem import Positions, Solver

_REST_DRAG = EtherDragEffect(decay_rate=2.0)
"""Drag until rest is reached, which does not change the state of rest."""
SAFETY_FACTOR = 1.25
"""Factor on the error estimated from two refinements of known order (Roache 1994, grid convergence index)."""
ROUNDOFF_FRACTION = 1e-7
"""Error, relative to the largest value, that the tolerances of steps and of rest explain."""


@dataclass(frozen=True)
class ClosedForm:
    """A case with a closed form.

    Attributes:
        name: name of the case.
        quantity: what is compared, with its unit.
        refined: what is refined.
        levels: numbers of steps or of springs.
        order: order of the discretisation's error.
        exact: exact value.
        simulate: simulates the value of a level with a solver.
        model_error: difference of the simulated model from the closed form's, not reduced by refinement.
        remark: what else the case shows, from the finest level.
    """

    name: str
    quantity: str
    refined: str
    levels: tuple[int, ...]
    order: float
    exact: float
    simulate: Callable[[int, Solver], float]
    model_error: float = 0.0
    remark: Callable[[int, Solver], str] | None = field(default=None)


def list_closed_forms() -> list[ClosedForm]:
    """Return all cases with a closed form."""
    return [
        ClosedForm("free fall", "height after 1 s [m]", "time step", (25, 50, 100), 1.0, -GRAVITY / 2, _fall_freely),
        _build_pendulum(),
        _build_oscillator(),
        _build_catenary("inextensible catenary", 1e6, inextensible=True),
        _build_catenary("elastic catenary", 2000.0, inextensible=False),
        _build_hanging_chain(),
        _build_clamped_cantilever(),
        _build_hinged_cantilever(),
        _build_slope("sliding on a slope", 0.3),
        _build_slope("sticking on a slope", 0.7),
        _build_membrane(),
    ]


def _fall_freely(num_steps: int, solver: Solver) -> float:
    mesh = NetworkMesh(positions=((0.0, 0.0, 0.0),)).build_mesh()
    scene = build_validation_scene(mesh, [GravityEffect()], time_step=1.0 / num_steps, mass=1.0)
    return float(simulate_to_time(scene, solver, num_steps)[-1][0, 1])


def _build_pendulum(angle: float = np.deg2rad(60.0), duration: float = 0.5) -> ClosedForm:
    k = np.sin(angle / 2)
    _, cn, dn, _ = scipy.special.ellipj(np.sqrt(GRAVITY) * duration, k**2)
    bob = (float(np.sin(angle)), float(-np.cos(angle)), 0.0)

    def simulate_angle(num_steps: int, solver: Solver) -> float:
        mesh = NetworkMesh(positions=((0.0, 0.0, 0.0), bob), springs=((0, 1),), mass=(0.0, 1.0)).build_mesh()
        effects = [
            SpringsEffect(scaling_rule="fixed", stretch=1e6),
            GravityEffect(),
            PinsEffect(indices=(0,), weight="exact"),
        ]
        scene = build_validation_scene(mesh, effects, time_step=duration / num_steps)
        x, y, _ = simulate_to_time(scene, solver, num_steps)[-1][1]
        return float(np.rad2deg(np.arctan2(x, -y)))

    exact = 2.0 * np.rad2deg(np.arcsin(k * cn / dn))
    return ClosedForm(
        "pendulum",
        "angle after 0.5 s, from 60 degrees",
        "time step",
        (100, 200, 400),
        1.0,
        float(exact),
        simulate_angle,
    )


def _build_oscillator(k: float = 100.0, c: float = 2.0, stretch: float = 0.1, duration: float = 0.4) -> ClosedForm:
    d = c / 2.0
    w = np.sqrt(k - d**2)

    def simulate_oscillator(num_steps: int, solver: Solver) -> list[Positions]:
        ends = (0.0, 0.0, 0.0), (1.0 + stretch, 0.0, 0.0)
        spring = NetworkMesh(positions=ends, springs=((0, 1),), stiffness=k, rest_length=1.0, mass=(0.0, 1.0))
        effects = [
            SpringsEffect(),
            DashpotsEffect(scaling_rule="fixed", stretch=c),
            PinsEffect(indices=(0,), weight="exact"),
        ]
        scene = build_validation_scene(spring.build_mesh(), effects, time_step=duration / num_steps)
        return simulate_to_time(scene, solver, num_steps)

    def measure_displacement(num_steps: int, solver: Solver) -> float:
        return float(simulate_oscillator(num_steps, solver)[-1][1, 0] - 1.0)

    def estimate_decay(num_steps: int, solver: Solver) -> str:
        """Fit x_(n+1) = a x_n + b x_(n-1), whose amplitude decays by sqrt(-b) a step."""
        x = np.array([p[1, 0] - 1.0 for p in simulate_oscillator(num_steps, solver)])
        _, b = np.linalg.lstsq(np.column_stack([x[1:-1], x[:-2]]), x[2:], rcond=None)[0]
        dt = duration / num_steps
        decay = -np.log(-b) / (2.0 * dt)
        own = np.log1p(c * dt + k * dt**2) / (2.0 * dt) - np.log1p(c * dt) / (2.0 * dt)
        physical = np.log1p(c * dt) / (2.0 * dt)
        return f"decay {decay:.4g}/s, of which the dashpot {physical:.4g} and implicit Euler {own:.4g}; exact {d:.4g}"

    exact = stretch * np.exp(-d * duration) * (np.cos(w * duration) + d / w * np.sin(w * duration))
    return ClosedForm(
        "damped oscillator", "displacement after 0.4 s [m]", "time step", (200, 400, 800), 1.0, float(exact),
        measure_displacement, remark=estimate_decay,
    )  # fmt: skip


def _hang_cable(num_springs: int, axial_stiffness: float, span: float, solver: Solver) -> Positions:
    """Return the rest state (n, 3) [m] of a cable between two supports.

    Its length is 10 m, its mass 10 kg.
    """
    x = np.linspace(0.0, span, num_springs + 1)
    sag = 2.0 * np.sin(np.pi * x / span)
    weights = np.full(num_springs + 1, 10.0 / num_springs)
    weights[[0, -1]] /= 2.0
    mesh = NetworkMesh(
        positions=tuple((float(a), float(-b), 0.0) for a, b in zip(x, sag, strict=True)),
        springs=tuple((i, i + 1) for i in range(num_springs)),
        axial_stiffness=axial_stiffness,
        rest_length=10.0 / num_springs,
        mass=tuple(weights.tolist()),
    ).build_mesh()
    effects = [SpringsEffect(), GravityEffect(), _REST_DRAG, PinsEffect(indices=(0, num_springs), weight="exact")]
    return simulate_to_rest(build_validation_scene(mesh, effects, time_step=REST_STEP), solver)


def solve_elastic_catenary(axial_stiffness: float, span: float = 8.0, length: float = 10.0) -> tuple[float, float]:
    """Return horizontal tension [N] and sag [m] of a cable of 1 kg/m.

    Source: Irvine 1981, equations 1.30 and 1.31.

    Args:
        axial_stiffness: force per strain EA [N].
        span: distance of the supports, which are level [m].
        length: unstretched length [m].
    """
    weight = length * GRAVITY
    V = weight / 2

    def compute_span(H: float) -> float:
        return H * length / axial_stiffness + 2 * H * length / weight * np.arcsinh(V / H)

    H = scipy.optimize.brentq(lambda H: compute_span(H) - span, 1e-3 * weight, 100.0 * weight, xtol=1e-13)
    sag = weight * length / (8 * axial_stiffness) + H * length / weight * (np.hypot(1.0, V / H) - 1.0)
    return float(H), float(sag)


def _build_catenary(name: str, axial_stiffness: float, *, inextensible: bool) -> ClosedForm:
    elastic = solve_elastic_catenary(axial_stiffness)[1]
    exact = solve_elastic_catenary(1e15)[1] if inextensible else elastic

    def measure_sag(num_springs: int, solver: Solver) -> float:
        return -float(_hang_cable(num_springs, axial_stiffness, 8.0, solver)[:, 1].min())

    return ClosedForm(
        name, "sag [m]", "springs", (10, 20, 40), 2.0, exact, measure_sag, model_error=abs(elastic - exact)
    )


def _build_hanging_chain(length: float = 2.0, mass: float = 4.0, axial_stiffness: float = 500.0) -> ClosedForm:
    def measure_elongation(num_springs: int, solver: Solver) -> float:
        y = -np.linspace(0.0, length, num_springs + 1)
        weights = np.full(num_springs + 1, mass / num_springs)
        weights[[0, -1]] /= 2.0
        mesh = NetworkMesh(
            positions=tuple((0.0, float(a), 0.0) for a in y),
            springs=tuple((i, i + 1) for i in range(num_springs)),
            axial_stiffness=axial_stiffness,
            mass=tuple(weights.tolist()),
        ).build_mesh()
        effects = [SpringsEffect(), GravityEffect(), _REST_DRAG, PinsEffect(indices=(0,), weight="exact")]
        p = simulate_to_rest(build_validation_scene(mesh, effects, time_step=REST_STEP), solver)
        return -float(p[-1, 1]) - length

    exact = mass * GRAVITY * length / (2.0 * axial_stiffness)
    return ClosedForm(
        "hanging chain", "elongation by its weight [m]", "springs", (5, 10, 20), 2.0, exact, measure_elongation
    )


def solve_elastica(length: float, weight_to_rigidity: float) -> tuple[float, float]:
    """Return drop and horizontal reach [m] of a clamped strip's tip under its weight.

    Args:
        length: free length [m].
        weight_to_rigidity: weight per area over flexural rigidity [1/m^3].
    """

    def evaluate_slope(s: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([y[1], -weight_to_rigidity * (length - s) * np.cos(y[0]), -np.sin(y[0]), np.cos(y[0])])

    def evaluate_boundary(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([a[0], b[1], a[2], a[3]])

    s = np.linspace(0.0, length, 41)
    guess = np.zeros((4, len(s)))
    guess[0] = np.minimum(weight_to_rigidity * length**3 / 6, 1.2) * s / length
    found = scipy.integrate.solve_bvp(evaluate_slope, evaluate_boundary, s, guess, tol=1e-10, max_nodes=100_000)
    return float(abs(found.y[2, -1])), float(found.y[3, -1])


def hang_strip(
    length: float, num_cells: int, rigidity: float, density: float, stretch: Any, solver: Solver, *, clamped: bool
) -> Positions:
    """Simulate a strip that is clamped or hinged at one end, until it rests.

    The strip extends along x from x = 0, and is one cell wide; a clamp extends by a cell to x < 0. Vertices are ordered
    along x.

    Args:
        length: free length [m].
        num_cells: number of cells along it.
        rigidity: flexural rigidity [N m].
        density: mass per area [kg/m^2].
        stretch: membrane stiffness, in the unit of `springs`.
        solver: the solver.
        clamped: whether the strip is clamped; otherwise it is hinged.

    Returns:
        The positions at rest (n, 3) [m].
    """
    h = length / num_cells
    x = h * np.arange(-1 if clamped else 0, num_cells + 1)
    mesh = build_sheet(np.asarray(x, np.float64), np.array([0.0, h]))
    fixed = np.flatnonzero(mesh.rest_positions[:, 0] < 0.5 * h)
    effects: list[Any] = [
        SpringsEffect(stretch=stretch, shear=0.5 * stretch),
        GravityEffect(),
        _REST_DRAG,
        PinsEffect(indices=tuple(fixed.tolist()), weight="exact"),
    ]
    if rigidity:
        effects.append(BendingEffect(stiffness=rigidity))
    mass = density * h * (x[-1] - x[0])
    return simulate_to_rest(build_validation_scene(mesh, effects, time_step=REST_STEP, mass=float(mass)), solver)


def _build_clamped_cantilever(length: float = 0.1, density: float = 0.2, rigidity: float = 2e-4) -> ClosedForm:
    exact = solve_elastica(length, density * GRAVITY / rigidity)[0]

    def measure_drop(num_cells: int, solver: Solver) -> float:
        return -float(hang_strip(length, num_cells, rigidity, density, 2e3, solver, clamped=True)[:, 1].min())

    return ClosedForm(
        "clamped cantilever", "drop of the tip by its weight [m]", "cells", (10, 20, 40), 1.0, exact, measure_drop,
        model_error=1e-4 * exact,
    )  # fmt: skip


def _build_hinged_cantilever(length: float = 0.1, density: float = 0.2, stretch: float = 100.0) -> ClosedForm:
    def measure_depth(num_cells: int, solver: Solver) -> float:
        p = hang_strip(length, num_cells, 1e-5, density, stretch, solver, clamped=False)
        return -float(p[:, 1].min())

    # A strip of one cell has two lines of stiffness k, and diagonals s: 2 (k + s k/(2 (s + k))) per width.
    s = 0.5 * stretch
    along = 2.0 * (stretch + 0.5 * s * stretch / (s + stretch))
    exact = length + density * GRAVITY * length**2 / (2.0 * along)
    return ClosedForm(
        "hinged cantilever", "depth of the tip, hanging [m]", "cells", (4, 8, 16), 1.0, exact, measure_depth
    )


def _build_slope(name: str, friction: float, angle: float = np.deg2rad(27.0), duration: float = 0.5) -> ClosedForm:
    normal = (float(np.sin(angle)), float(np.cos(angle)), 0.0)
    gap = 0.005

    def measure_displacement(num_steps: int, solver: Solver) -> float:
        start = tuple(gap * one for one in normal)
        mesh = NetworkMesh(positions=(start,)).build_mesh()  # pyright: ignore[reportArgumentType]
        contact: Any = {
            "obstacles": ({"kind": "plane", "point": (0.0, 0.0, 0.0), "normal": normal},),
            "min_distance": gap,
            "friction": friction,
        }
        effects = [GravityEffect(), ContactEffect(**contact)]
        scene = build_validation_scene(mesh, effects, time_step=duration / num_steps, mass=1.0)
        moved = simulate_to_time(scene, solver, num_steps)[-1][0] - np.array(start)
        return float(np.linalg.norm(moved - np.dot(moved, normal) * np.array(normal)))

    along = max(0.0, np.sin(angle) - friction * np.cos(angle)) * GRAVITY
    return ClosedForm(
        name, f"displacement after 0.5 s [m], friction {friction:g}", "time step", (25, 50, 100), 1.0,
        float(along * duration**2 / 2), measure_displacement, model_error=1e-5 * duration if along == 0.0 else 0.0,
    )  # fmt: skip


def _build_membrane(side: float = 1.0, pressure: float = 10.0, tension: float = 200.0) -> ClosedForm:
    """Build the case of a square soap film.

    Springs of rest length 0 and stiffness T are the five-point Laplacian of a film of tension T.
    """

    def measure_height(num_cells: int, solver: Solver) -> float:
        n, h = num_cells + 1, side / num_cells
        index = np.arange(n * n).reshape(n, n)
        pairs = build_offset_pairs(index, (1, 0), (0, 1))
        x = np.linspace(0.0, side, n)
        mesh = NetworkMesh(
            positions=tuple((float(a), 0.0, float(b)) for a in x for b in x),
            springs=tuple((int(i), int(j)) for i, j in pairs),
            force_density=tension,
        ).build_mesh()
        boundary = np.unique(np.concatenate([index[0], index[-1], index[:, 0], index[:, -1]]))
        effects = [
            SpringsEffect(),
            ConstantForceEffect(force=(0.0, pressure * h**2, 0.0)),
            _REST_DRAG,
            PinsEffect(indices=tuple(boundary.tolist()), weight="exact"),
        ]
        p = simulate_to_rest(build_validation_scene(mesh, effects, time_step=REST_STEP, mass=0.1), solver)
        return float(p[:, 1].max())

    return ClosedForm(
        "membrane under pressure", "height of the centre [m]", "cells a side", (8, 16, 32), 2.0,
        0.0736713532815 * pressure * side**2 / tension, measure_height,
    )  # fmt: skip
