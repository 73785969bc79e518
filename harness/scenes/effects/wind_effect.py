"""Wind: a force field on vertices, or an air velocity field on triangles (drag and lift).

On triangles (Keckeisen et al. 2004), with the air velocity u relative to the triangle, its area A, its normal n on the
downstream side, and the air density rho:

    f = rho/2 A |u| (n.u) (C_D u/|u| + C_L (n - (n.u) u/|u|^2))

Forces are evaluated at the start of the step. The force on a triangle is limited to what accelerates it to the velocity
of the air in one step, f dt <= m |u|; otherwise light cloth is unstable in a storm. The field is one of

    constant    uniform in space and time
    gusts       the constant one, and waves that it advects (after Kraichnan 1970): each component varies by the
                fraction `turbulence_intensity` of the mean's magnitude (root mean square), at 16 frequencies
                around `frequency`
    assignment  that of the University of Toronto assignment, with t the simulated time [s], b the diagonal of
                the rest bounding box and phi = x / b + t at the current x:

                    (3 + 1.5 (1 + cos 5 phi),  1 + cos(0.3 + phi),  sin phi)

                (the assignment adds a gravity of -9.8 newtons to the second component; here gravity is another effect)

The field is in newtons on vertices, and in metres per second on triangles.
"""

from collections.abc import Callable
from math import inf
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, model_validator
from springbench.harness.errors import InputError
from springbench.harness.scenes.effects.effect_interface import EffectContribution, ForceFunction, build_constant_force
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.schema.base_model import ConfigModel, Vector3
from springbench.solvers.model.step_problem import Positions

WindField = Callable[[Positions, float], Positions]
"""(points (k, 3) [m], time [s]) -> the field there, (k, 3) or (3,)."""

_GUST_WAVES = 16


class WindEffect(ConfigModel):
    """Wind on the mesh."""

    max_convergence_order: ClassVar[float] = inf

    kind: Literal["wind"] = "wind"
    field: Literal["constant", "gusts", "assignment"] = "constant"
    """Variation of the field: constant, random gusts, or the assignment's waves along x."""
    acts_on: Literal["vertex", "mass", "triangle"] = "mass"
    """Target of the field. `vertex`: the force acts on every vertex, as in the assignment, so the total grows with the
    mesh size; `mass`: the field is the total force, distributed like the mass, independent of the mesh size;
    `triangle`: the field is the velocity of the air, with drag and lift on triangles."""
    force: Vector3 = (1.0, 0.0, 0.0)
    """Constant field, or mean of the gusts, on vertices [N]."""
    velocity: Vector3 = (1.0, 0.0, 0.0)
    """Constant field, or mean of the gusts, on triangles [m/s]; zero is still air, which causes drag."""
    strength: float = 1.0
    """Factor of the field; zero disables the wind, including its drag."""
    turbulence_intensity: NonNegativeFloat = 0.3
    """gusts: root mean square variation of each component relative to the mean."""
    frequency: PositiveFloat = 1.0
    """gusts: centre frequency [1/s]; frequencies range from a quarter to four times of it."""
    seed: NonNegativeInt = 0
    """gusts: random seed; the same seed gives the same gusts at all times and mesh sizes."""
    air_density: NonNegativeFloat = 1.2
    """triangle: density of the air [kg/m^3]."""
    drag_coefficient: NonNegativeFloat = 1.0
    """triangle: drag coefficient C_D."""
    lift_coefficient: NonNegativeFloat = 0.0
    """triangle: lift coefficient C_L."""

    @model_validator(mode="after")
    def _check_options(self) -> "WindEffect":
        unused = {"triangle": {"force"}}.get(
            self.acts_on, {"velocity", "air_density", "drag_coefficient", "lift_coefficient"}
        )
        if self.field != "gusts":
            unused = unused | {"turbulence_intensity", "frequency", "seed"}
        if self.field == "assignment":
            unused = unused | {"force", "velocity"}
        for key in sorted(unused & self.model_fields_set):
            raise ValueError(f"`{key}` has no meaning for the field {self.field} per {self.acts_on}; leave it out")
        return self

    @property
    def mean_field(self) -> NDArray[np.float64]:
        """Constant field or mean of the gusts, (3,) [N] or [m/s], including the strength."""
        return self.strength * np.array(self.velocity if self.acts_on == "triangle" else self.force)

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Return the field as one force, empty for zero strength.

        Args:
            mesh: mesh, on whose vertices or triangles the wind acts.
            mass: vertex masses (n,) [kg], which limit the force on triangles.
            time_step: dt [s], in which a triangle reaches the velocity of the air at most.

        Raises:
            InputError: the wind acts on triangles, and the mesh has none.
        """
        if not self.strength:
            return EffectContribution()
        if self.acts_on == "triangle":
            return EffectContribution(forces=_triangle_wind(self, mesh, mass, time_step))
        weight = np.ones(len(mass)) if self.acts_on == "vertex" else mesh.mass_fractions
        return EffectContribution(forces=_vertex_wind(self, mesh, weight[:, None]))


def _vertex_wind(wind: WindEffect, mesh: Mesh, weight: NDArray[np.float64]) -> tuple[ForceFunction, ...]:
    """Return the field times weights (n, 1) as a force on vertices."""
    if wind.field == "constant" or (wind.field == "gusts" and not wind.mean_field.any()):
        return build_constant_force(weight * wind.mean_field)
    field = _FIELD_BUILDERS[wind.field](wind, mesh)

    def force(p: Positions, v: Positions, t: float) -> Positions:
        return weight * field(p, t)

    return (force,)


def _triangle_wind(wind: WindEffect, mesh: Mesh, mass: NDArray[np.float64], dt: float) -> tuple[ForceFunction, ...]:
    triangles, field = mesh.triangles, _FIELD_BUILDERS[wind.field](wind, mesh)
    if not len(triangles):
        raise InputError("wind: acts_on: triangle needs triangles, and this mesh has none; take acts_on: mass")
    if not wind.air_density or not (wind.drag_coefficient or wind.lift_coefficient):
        return ()
    limit = _lump_triangle_masses(mesh, mass) / dt
    coefficients = np.array([0.5 * wind.air_density, wind.drag_coefficient, wind.lift_coefficient])

    def force(p: Positions, v: Positions, t: float) -> Positions:
        from springbench.solvers.kernels import wind_forces  # for scenes with wind

        p, v = np.ascontiguousarray(p), np.ascontiguousarray(v)
        centres, scratch, out = np.empty((len(triangles), 3)), np.empty((len(triangles), 3)), np.empty_like(p)
        wind_forces.compute_triangle_centres(p, triangles, centres)
        air = np.ascontiguousarray(np.broadcast_to(field(centres, t), centres.shape))
        wind_forces.compute_triangle_wind(p, v, triangles, air, limit, coefficients, scratch, out)
        return out

    return (force,)


def _lump_triangle_masses(mesh: Mesh, mass: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the mass that moves with each triangle, (f,) [kg]: vertex masses divided by rest areas."""
    a, b, c = (mesh.rest_positions[corner] for corner in mesh.triangles.T)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    around = np.bincount(mesh.triangles.ravel(), np.repeat(area, 3), minlength=len(mass))
    dealt = np.divide(mass, around, out=np.zeros_like(mass), where=around > 0.0)
    return area * dealt[mesh.triangles].sum(axis=1)


def _constant_field(wind: WindEffect, mesh: Mesh) -> WindField:
    return lambda x, t: wind.mean_field


def _gust_field(wind: WindEffect, mesh: Mesh) -> WindField:
    rng, mean = np.random.default_rng(wind.seed), wind.mean_field
    size = float(np.linalg.norm(mean))
    if not size:
        return _constant_field(wind, mesh)
    turns = 2.0 * np.pi * wind.frequency * np.exp(rng.uniform(np.log(0.25), np.log(4.0), _GUST_WAVES))
    phase = rng.uniform(0.0, 2.0 * np.pi, (_GUST_WAVES, 3))
    height = wind.turbulence_intensity * size * (2.0 / _GUST_WAVES) ** 0.5  # a cosine's mean square is 1/2
    # Moving air advects its gusts. A force field has no speed; its waves cross the mesh in a second.
    carried = mean / size**2 if wind.acts_on == "triangle" else mean / size / (mesh.bounding_box_diagonal or 1.0)

    def field(x: Positions, t: float) -> Positions:
        from springbench.solvers.kernels.wind_forces import evaluate_gusts  # for scenes with gusts

        return evaluate_gusts(t - x @ carried, turns, phase, mean, height)

    return field


def _assignment_field(wind: WindEffect, mesh: Mesh) -> WindField:
    diagonal = mesh.bounding_box_diagonal or 1.0

    def field(x: Positions, t: float) -> Positions:
        phi = x[:, 0] / diagonal + t
        f = np.stack([3.0 + 1.5 * (1.0 + np.cos(5.0 * phi)), 1.0 + np.cos(0.3 + phi), np.sin(phi)], axis=1)
        return wind.strength * f

    return field


_FIELD_BUILDERS: dict[str, Callable[[WindEffect, Mesh], WindField]] = {
    "assignment": _assignment_field,
    "constant": _constant_field,
    "gusts": _gust_field,
}
