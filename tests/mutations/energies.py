"""Lies in energies, contact and effects: name, file, fragment, replacement, tests."""

from __future__ import annotations

from tests.mutations.base import Mutation

_E, _U, _F = "solvers/energies", "tests/unit", "harness/scenes/effects"
_SPRINGS, _GAS, _DAMPING, _BENDING = (
    f"{_U}/test_{name}.py" for name in ("springs_energy", "effect_gas", "effect_damping", "effect_bending")
)
_STEPS, _SLOPES = f"{_U}/test_simulate.py", f"{_U}/test_effect_energies.py"

_TABLE = (
    (
        "springs-value",
        f"{_E}/springs.py",
        "return 0.5 * float(self.stiffness",
        "return 0.6 * float(self.stiffness",
        _SPRINGS,
    ),
    (
        "springs-gradient",
        f"{_E}/springs.py",
        "self._add(v - self.rest_length",
        "self._add(v + self.rest_length",
        _SPRINGS,
    ),
    (
        "springs-projection",
        f"{_E}/springs.py",
        "self._add(self.rest_length",
        "self._add(1.01 * self.rest_length",
        _SPRINGS,
    ),
    ("springs-hessian", f"{_E}/springs.py", "1.0, 1.0 - ratio)", "1.0, 1.0 + ratio)", _SPRINGS),
    ("gas-value", f"{_E}/gas.py", "return -self.pressure *", "return -2.0 * self.pressure *", _GAS),
    ("gas-gradient", f"{_E}/gas.py", "corner, area / 6.0)", "corner, area / 3.0)", _GAS),
    ("gas-hessian", f"{_E}/gas.py", "(np.sqrt(pressure / volume) *", "(np.sqrt(2.0 * pressure / volume) *", _SLOPES),
    ("dashpots-origin", f"{_E}/dashpots.py", "self._along(start.origin)", "self._along(start.expected)", _DAMPING),
    (
        "dashpots-rate",
        f"{_E}/dashpots.py",
        "stiffness=start.rate * self",
        "stiffness=0.5 * start.rate * self",
        _DAMPING,
    ),
    ("bending-sign", f"{_E}/bending.py", "-c02 - c04], axis=1)", "-c02 + c04], axis=1)", _BENDING),
    ("bending-cuts", f"{_E}/bending.py", "[stiffness / len(parts) / area", "[stiffness / area", _BENDING),
    (
        "attachments-time",
        f"{_E}/attachments.py",
        "self.points(start.until)",
        "self.points(start.time)",
        f"{_U}/test_effect_motion.py",
    ),
    (
        "limits-clip",
        f"{_E}/strain_limits.py",
        "np.clip(length, self.low, self.high)",
        "np.clip(length, self.low, self.low)",
        f"{_U}/test_effect_strain_limits.py",
    ),
    (
        "limits-lateral",
        f"{_E}/strain_limits.py",
        "np.divide(beyond, length,",
        "np.divide(2.0 * beyond, length,",
        f"{_U}/test_effect_energies.py",
    ),
    (
        "quadratic-gradient",
        f"{_E}/quadratic.py",
        "out += self._pulled(self.A @ p - self.d)",
        "out += self._pulled(self.A @ p + self.d)",
        f"{_U}/test_effect_energies.py",
    ),
    (
        "viscous-rate",
        f"{_E}/quadratic.py",
        "weight=start.rate * self.weight",
        "weight=2.0 * start.rate * self.weight",
        _DAMPING,
    ),
    (
        "contact-side",
        "solvers/contact/half_space/half_space_potential.py",
        "@ np.minimum(0.0, self.gap(p)) ** 2",
        "@ np.maximum(0.0, self.gap(p)) ** 2",
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
    ("gravity-mass", f"{_F}/gravity.py", "mass[:, None] * np.array", "mass.mean() * np.array", f"{_U}/test_effects.py"),
    ("ether-decay", f"{_F}/ether_drag.py", "exp(-self.rate * time_step)", "1.0 - self.rate * time_step", _STEPS),
    (
        "air-drag",
        "solvers/model/velocity_filters.py",
        "np.divide(mass, mass + drag,",
        "np.divide(mass, mass + 2.0 * drag,",
        _DAMPING,
    ),
    ("wind-density", f"{_F}/wind.py", "f = 0.5 * wind.density", "f = wind.density", f"{_U}/test_effect_wind.py"),
)

ENERGIES = tuple(Mutation(name, file, old, new, (tests,)) for name, file, old, new, tests in _TABLE)
