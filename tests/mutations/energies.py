"""Planted errors in energies, contact and effects: name, file, fragment, replacement, tests."""

from __future__ import annotations

from tests.mutations.base import Mutation

_U = "tests/unit"
_SPRINGS, _GAS, _DAMPING, _BENDING = (
    f"{_U}/test_{name}.py" for name in ("springs_energy", "effect_gas", "effect_damping", "effect_bending")
)
_STEPS, _SLOPES = f"{_U}/test_simulate.py", f"{_U}/test_effect_energies.py"

_TABLE = (
    (
        "springs-value",
        "solvers/model/energies/spring_energy.py",
        "return 0.5 * float(self.stiffness",
        "return 0.6 * float(self.stiffness",
        _SPRINGS,
    ),
    (
        "springs-gradient",
        "solvers/model/energies/spring_energy.py",
        "self._scatter_forces(v - self.rest_length",
        "self._scatter_forces(v + self.rest_length",
        _SPRINGS,
    ),
    (
        "springs-projection",
        "solvers/model/energies/spring_energy.py",
        "self._scatter_forces(self.rest_length",
        "self._scatter_forces(1.01 * self.rest_length",
        _SPRINGS,
    ),
    ("springs-hessian", "solvers/model/energies/spring_energy.py", "1.0, 1.0 - ratio)", "1.0, 1.0 + ratio)", _SPRINGS),
    (
        "gas-value",
        "solvers/model/energies/gas_energy.py",
        "-self.rest_pressure * self.rest_volume",
        "-2.0 * self.rest_pressure * self.rest_volume",
        _GAS,
    ),
    ("gas-gradient", "solvers/model/energies/gas_energy.py", "corner, area / 6.0)", "corner, area / 3.0)", _GAS),
    (
        "gas-hessian",
        "solvers/model/energies/gas_energy.py",
        "(np.sqrt(pressure / volume) *",
        "(np.sqrt(2.0 * pressure / volume) *",
        _SLOPES,
    ),
    (
        "dashpots-origin",
        "solvers/model/energies/dashpot_energy.py",
        "self._edge_vectors(start.velocity_origin)",
        "self._edge_vectors(start.lagged_positions)",
        _DAMPING,
    ),
    (
        "dashpots-rate",
        "solvers/model/energies/dashpot_energy.py",
        "stiffness=start.velocity_rate * self",
        "stiffness=0.5 * start.velocity_rate * self",
        _DAMPING,
    ),
    (
        "bending-sign",
        "solvers/model/energies/bending_energy.py",
        "-c02 - c04], axis=1)",
        "-c02 + c04], axis=1)",
        _BENDING,
    ),
    (
        "bending-cuts",
        "solvers/model/energies/bending_energy.py",
        "[stiffness / len(parts) / area",
        "[stiffness / area",
        _BENDING,
    ),
    (
        "attachments-time",
        "solvers/model/energies/attachment_energy.py",
        "self.anchor_positions_at(start.stage_time)",
        "self.anchor_positions_at(start.time)",
        f"{_U}/test_effect_motion.py",
    ),
    (
        "limits-clip",
        "solvers/model/energies/strain_limit_energy.py",
        "np.clip(length, self.min_length, self.max_length)",
        "np.clip(length, self.min_length, self.min_length)",
        f"{_U}/test_effect_strain_limits.py",
    ),
    (
        "limits-lateral",
        "solvers/model/energies/strain_limit_energy.py",
        "np.divide(beyond, length,",
        "np.divide(2.0 * beyond, length,",
        f"{_U}/test_effect_energies.py",
    ),
    (
        "quadratic-gradient",
        "solvers/model/energies/quadratic_energy.py",
        "out += self._weighted_transpose(self.A @ p - self.d)",
        "out += self._weighted_transpose(self.A @ p + self.d)",
        f"{_U}/test_effect_energies.py",
    ),
    (
        "viscous-rate",
        "solvers/model/energies/quadratic_energy.py",
        "weight=start.velocity_rate * self.weight",
        "weight=2.0 * start.velocity_rate * self.weight",
        _DAMPING,
    ),
    (
        "contact-side",
        "solvers/contact/half_space/half_space_potential.py",
        "@ np.minimum(0.0, self.compute_gaps(p)) ** 2",
        "@ np.maximum(0.0, self.compute_gaps(p)) ** 2",
        _SLOPES,
    ),
    (
        "contact-friction",
        "solvers/contact/half_space/half_space_potential.py",
        "self.friction * stiffness * np.maximum(0.0, depth)",
        "0.9 * self.friction * stiffness * np.maximum(0.0, depth)",
        f"{_U}/test_effect_contact.py",
    ),
    (
        "contact-way",
        "solvers/contact/half_space/separating_planes.py",
        "s = begin - (far - radius) / slope",
        "s = begin - (far - 0.5 * radius) / slope",
        f"{_U}/test_contact_planes.py",
    ),
    (
        "gravity-mass",
        "harness/scenes/effects/gravity_effect.py",
        "mass[:, None] * np.array",
        "mass.mean() * np.array",
        f"{_U}/test_effects.py",
    ),
    (
        "ether-decay",
        "harness/scenes/effects/ether_drag_effect.py",
        "exp(-self.decay_rate * time_step)",
        "1.0 - self.decay_rate * time_step",
        _STEPS,
    ),
    (
        "air-drag",
        "solvers/model/velocity_filters.py",
        "np.divide(mass, mass + drag,",
        "np.divide(mass, mass + 2.0 * drag,",
        _DAMPING,
    ),
    (
        "wind-density",
        "harness/scenes/effects/wind_effect.py",
        "0.5 * wind.air_density",
        "1.0 * wind.air_density",
        f"{_U}/test_effect_wind.py",
    ),
)

_REFERENCE_TERMS = "tests/oracles/test_scenes.py::test_both_implementations_agree_on_all_effects_together"
_BEYOND_REFERENCE_TERMS = ("springs-projection",)
"""Errors beyond values, gradients and Hessians, which are all that the reference terms are compared with."""

ENERGIES = tuple(Mutation(name, file, old, new, (tests,)) for name, file, old, new, tests in _TABLE)
ENERGIES += tuple(
    Mutation(f"{name}-reference", file, old, new, (_REFERENCE_TERMS,))
    for name, file, old, new, _ in _TABLE
    if name not in _BEYOND_REFERENCE_TERMS
)
