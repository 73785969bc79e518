"""The comparison finds errors planted in energies, forces, pins, filters, integrators, masses and the objective."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from springbench.harness.scenes import spring_stiffness
from springbench.harness.scenes.key_frames import KeyFrameMotion
from springbench.harness.scenes.scene_builder import Scene
from springbench.solvers.contact.half_space.half_space_potential import HalfSpaceContact
from springbench.solvers.model.energies.attachment_energy import Attachments
from springbench.solvers.model.energies.bending_energy import Bending
from springbench.solvers.model.energies.dashpot_energy import Dashpots, RayleighDashpots
from springbench.solvers.model.energies.gas_energy import Gas
from springbench.solvers.model.energies.quadratic_energy import AirDrag, RayleighDamping
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.energies.strain_limit_energy import StrainLimits
from springbench.solvers.model.integrators import SingleStageIntegrator
from springbench.solvers.model.step_problem import StepProblem, System

from tests.oracles.planted_errors import (
    AIR_DRAG_SPEC,
    ATTACHMENTS_SPEC,
    BALLOON_SPEC,
    BEND_SPRINGS_SPEC,
    BENDING_SPEC,
    DASHPOTS_SPEC,
    DRAG_SPECS,
    FLOOR_SPEC,
    FORCE_SPECS,
    GAS_SPEC,
    GRAVITY_SPEC,
    GUSTS_SPEC,
    PINS_SPEC,
    RAYLEIGH_SPEC,
    SPRINGS_SPEC,
    STRAIN_LIMITS_SPEC,
    FormulaMutation,
    build_scene_spec,
    drop_term,
    mutate_contribution,
    mutate_energy,
    mutate_half_spaces,
    mutate_integrator,
    mutate_pins,
    mutate_step_energy,
    mutate_step_start,
    patch_attribute,
    run_reference_check,
    scale_fields,
    scale_filters,
    scale_forces,
    scale_method,
    scale_prediction,
    scale_steady_forces,
)

PER_VERTEX = {"kind": "wind", "field": "constant", "acts_on": "vertex", "force": (1, 0, 2)}
PLANTED_ERRORS: dict[str, FormulaMutation] = {
    "springs twice as stiff": FormulaMutation(
        [SPRINGS_SPEC], "springs", mutate_energy(Springs, scale_fields(stiffness=2.0))
    ),
    "springs a millionth longer": FormulaMutation(
        [SPRINGS_SPEC], "springs", mutate_energy(Springs, scale_fields(rest_length=1.0 + 1e-6))
    ),
    "springs' value alone": FormulaMutation([SPRINGS_SPEC], "springs (value)", scale_method(Springs, "value", 1.0001)),
    "springs' gradient alone": FormulaMutation(
        [SPRINGS_SPEC], "springs (gradient)", scale_method(Springs, "add_gradient", 1.0001)
    ),
    "springs' Hessian alone": FormulaMutation(
        [SPRINGS_SPEC], "springs (Hessian)", scale_method(Springs, "hessian", 1.01)
    ),
    "skip-one springs that stiffen the cloth": FormulaMutation(
        [BEND_SPRINGS_SPEC],
        "springs",
        patch_attribute(spring_stiffness, "_subtract_bend_stiffness", lambda true: lambda mesh, k: k),
    ),
    "limits that are wider": FormulaMutation(
        [SPRINGS_SPEC, STRAIN_LIMITS_SPEC], "strain-limits", mutate_energy(StrainLimits, scale_fields(max_length=1.01))
    ),
    "limits half as stiff": FormulaMutation(
        [SPRINGS_SPEC, STRAIN_LIMITS_SPEC], "strain-limits", mutate_energy(StrainLimits, scale_fields(stiffness=0.5))
    ),
    "dashpots twice as strong": FormulaMutation(
        [SPRINGS_SPEC, DASHPOTS_SPEC], "dashpots", mutate_energy(Dashpots, scale_fields(stiffness=2.0))
    ),
    "dashpots along the rest shape": FormulaMutation(
        [SPRINGS_SPEC, DASHPOTS_SPEC],
        "dashpots",
        patch_attribute(
            Dashpots,
            "begin_step",
            lambda true: lambda self, start: replace(true(self, start), direction=self.direction),
        ),
    ),
    "dashpots that damp motion to where it began": FormulaMutation(
        [SPRINGS_SPEC, DASHPOTS_SPEC], "dashpots", mutate_step_energy(Dashpots, scale_fields(offset=0.0))
    ),
    "damping by stiffness at another rate": FormulaMutation(
        [SPRINGS_SPEC, RAYLEIGH_SPEC],
        "rayleigh",
        mutate_step_start(RayleighDashpots, lambda start: replace(start, velocity_rate=1.1 * start.velocity_rate)),
    ),
    "damping by mass": FormulaMutation(
        [SPRINGS_SPEC, RAYLEIGH_SPEC], "rayleigh", mutate_energy(RayleighDamping, scale_fields(weight=1.01))
    ),
    "bending with the other sign": FormulaMutation(
        [SPRINGS_SPEC, BENDING_SPEC], "bending", mutate_energy(Bending, scale_fields(weight=-1.0))
    ),
    "bending with areas of one triangle": FormulaMutation(
        [SPRINGS_SPEC, BENDING_SPEC], "bending", mutate_energy(Bending, scale_fields(weight=2.0))
    ),
    "bending with wrong cotangents": FormulaMutation(
        [SPRINGS_SPEC, BENDING_SPEC],
        "bending",
        mutate_energy(Bending, lambda one: replace(one, A=csr_array(abs(one.A)))),
    ),
    "gas of twice the volume": FormulaMutation(
        [SPRINGS_SPEC, GAS_SPEC], "gas", mutate_energy(Gas, scale_fields(rest_volume=2.0)), mesh=BALLOON_SPEC, size=2
    ),
    "gas that pulls": FormulaMutation(
        [SPRINGS_SPEC, GAS_SPEC], "gas (gradient)", scale_method(Gas, "add_gradient", -1.0), mesh=BALLOON_SPEC, size=2
    ),
    "gas's Hessian without its sign": FormulaMutation(
        [SPRINGS_SPEC, GAS_SPEC], "gas (Hessian)", scale_method(Gas, "sparse_hessian", -1.0), mesh=BALLOON_SPEC, size=2
    ),
    "attachments ten times as stiff": FormulaMutation(
        [SPRINGS_SPEC, ATTACHMENTS_SPEC], "attachments", mutate_energy(Attachments, scale_fields(weight=10.0))
    ),
    "attachments where the points were": FormulaMutation(
        [SPRINGS_SPEC, ATTACHMENTS_SPEC],
        "attachments",
        mutate_step_start(Attachments, lambda start: replace(start, stage_time=start.time)),
    ),
    "drag without its rate": FormulaMutation(
        [SPRINGS_SPEC, AIR_DRAG_SPEC], "air-drag", mutate_step_energy(AirDrag, scale_fields(weight=1 / 30))
    ),
    "drag towards where the step starts, not its origin": FormulaMutation(
        [SPRINGS_SPEC, AIR_DRAG_SPEC],
        "air-drag",
        mutate_step_start(AirDrag, lambda start: replace(start, velocity_origin=start.positions)),
        integrator="bdf2",
    ),
    "friction at .9": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC], "contact", mutate_energy(HalfSpaceContact, scale_fields(friction=0.9))
    ),
    "friction of the step's start": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC],
        "friction's pressure",
        mutate_energy(HalfSpaceContact, lambda one: replace(one, friction_iterations=1)),
    ),
    "friction that sticks half as long": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC], "contact", mutate_energy(HalfSpaceContact, scale_fields(eps_v=0.5))
    ),
    "contact half as stiff": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC], "contact", mutate_energy(HalfSpaceContact, scale_fields(stiffness=0.5))
    ),
    "contact a little thicker": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC], "contact", mutate_energy(HalfSpaceContact, scale_fields(min_distance=1.01))
    ),
    "half-spaces a micrometre too high": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC],
        "contact",
        mutate_step_energy(HalfSpaceContact, mutate_half_spaces(offset=lambda planes: planes.offset + 1e-6)),
    ),
    "friction against a floor that moves": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC],
        "contact",
        mutate_step_energy(
            HalfSpaceContact, mutate_half_spaces(friction_anchor=lambda planes: planes.friction_anchor + 1e-5)
        ),
    ),
    "contact's normals tilted": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC],
        "contact",
        mutate_step_energy(
            HalfSpaceContact, mutate_half_spaces(normal=lambda planes: np.roll(planes.normal, 1, axis=1))
        ),
    ),
    "contact at the step's end for midpoint": FormulaMutation(
        [SPRINGS_SPEC, FLOOR_SPEC],
        "contact",
        mutate_step_start(HalfSpaceContact, lambda start: replace(start, stage_time=2 * start.stage_time - start.time)),
        integrator="midpoint",
    ),
    "gravity of the moon": FormulaMutation(
        [SPRINGS_SPEC, *FORCE_SPECS], "forces", mutate_contribution("gravity", scale_steady_forces(0.165))
    ),
    "gravity upwards": FormulaMutation(
        [SPRINGS_SPEC, GRAVITY_SPEC], "forces", mutate_contribution("gravity", scale_steady_forces(-1.0))
    ),
    "a force that is not shared": FormulaMutation(
        [SPRINGS_SPEC, *FORCE_SPECS], "forces", mutate_contribution("constant-force", scale_steady_forces(1.001))
    ),
    "wind a little stronger": FormulaMutation(
        [SPRINGS_SPEC, *FORCE_SPECS], "forces", mutate_contribution("wind", scale_forces(1.0 + 1e-9))
    ),
    "a steady wind the other way": FormulaMutation(
        [SPRINGS_SPEC, PER_VERTEX], "forces", mutate_contribution("wind", scale_steady_forces(-1.0))
    ),
    "gusts a little weaker on triangles": FormulaMutation(
        [SPRINGS_SPEC, GUSTS_SPEC], "forces", mutate_contribution("wind", scale_forces(1.0 - 1e-6))
    ),
    "forces of the step's start for BDF2": FormulaMutation(
        [SPRINGS_SPEC, *FORCE_SPECS], "forces", mutate_integrator("bdf2", extrapolation_fraction=0.0), "bdf2"
    ),
    "ether drag twice": FormulaMutation(
        [SPRINGS_SPEC, *DRAG_SPECS], "inertial target", mutate_contribution("ether-drag", scale_filters(0.9))
    ),
    "quadratic drag": FormulaMutation(
        [SPRINGS_SPEC, *DRAG_SPECS], "inertial target", mutate_contribution("air-drag", scale_filters(1.0 + 1e-9))
    ),
    "pins that are held elsewhere": FormulaMutation(
        [SPRINGS_SPEC, PINS_SPEC],
        "targets of pins",
        mutate_contribution("pins", mutate_pins(targets=lambda pin: pin.targets + 1e-6)),
    ),
    "pins that stand still": FormulaMutation(
        [SPRINGS_SPEC, PINS_SPEC], "targets of pins", mutate_contribution("pins", mutate_pins(motion=lambda pin: None))
    ),
    "pins with another weight": FormulaMutation(
        [SPRINGS_SPEC, PINS_SPEC],
        "weights of pins",
        mutate_contribution("pins", mutate_pins(weight=lambda pin: 2 * pin.weight)),
    ),
    "other pins": FormulaMutation(
        [SPRINGS_SPEC, PINS_SPEC],
        "pinned vertices",
        mutate_contribution("pins", mutate_pins(vertices=lambda pin: pin.vertices + 1)),
    ),
    "pins of the step's start": FormulaMutation(
        [SPRINGS_SPEC, PINS_SPEC],
        "targets of pins",
        patch_attribute(
            Scene, "compute_pin_targets", lambda true: lambda self, time: true(self, time - self.system.time_step)
        ),
    ),
    "key frames that turn the other way": FormulaMutation(
        [SPRINGS_SPEC, PINS_SPEC],
        "targets of pins",
        patch_attribute(
            KeyFrameMotion, "_interpolate_pose", lambda true: lambda self, time: true(self, time) * [1, 1, 1, -1]
        ),
    ),
    "implicit Euler that goes too far": FormulaMutation(
        [SPRINGS_SPEC], "inertial target", scale_prediction("implicit-euler", target=1.0 + 1e-6)
    ),
    "BDF2 with another coefficient": FormulaMutation(
        [SPRINGS_SPEC], "inertia", mutate_integrator("bdf2", inertia_factor=2.2), "bdf2"
    ),
    "BDF2 with another target": FormulaMutation(
        [SPRINGS_SPEC], "inertial target", scale_prediction("bdf2", target=1.001), "bdf2"
    ),
    "BDF2 with another origin": FormulaMutation(
        [SPRINGS_SPEC], "origin of velocities", scale_prediction("bdf2", origin=0.75), "bdf2"
    ),
    "BDF2 without its history": FormulaMutation(
        [SPRINGS_SPEC], "inertial target", mutate_integrator("bdf2", needs_history=False), "bdf2"
    ),
    "midpoint with another coefficient": FormulaMutation(
        [SPRINGS_SPEC], "inertia", mutate_integrator("midpoint", inertia_factor=2.0), "midpoint"
    ),
    "midpoint that ends in the middle": FormulaMutation(
        [SPRINGS_SPEC], "positions after the step", mutate_integrator("midpoint", stage_fraction=1.0), "midpoint"
    ),
    "midpoint with another target": FormulaMutation(
        [SPRINGS_SPEC], "inertial target", scale_prediction("midpoint", target=2.0), "midpoint"
    ),
    "velocities that are too fast": FormulaMutation(
        [SPRINGS_SPEC],
        "velocities after the step",
        patch_attribute(
            SingleStageIntegrator,
            "complete_step",
            lambda true: lambda *given: (after := true(*given))._replace(velocity=1.001 * after.velocity),
        ),
    ),
    "a heavier cloth": FormulaMutation(
        [SPRINGS_SPEC],
        "masses",
        patch_attribute(System, "__init__", lambda true: lambda self, mass, *more: true(self, 1.01 * mass, *more)),
    ),
    "an objective without its inertia": FormulaMutation(
        [SPRINGS_SPEC], "objective (value)", patch_attribute(StepProblem, "evaluate_terms", drop_term("inertia"))
    ),
    "an objective without an energy": FormulaMutation(
        [SPRINGS_SPEC, BENDING_SPEC],
        "objective (value)",
        patch_attribute(StepProblem, "evaluate_terms", drop_term("bending")),
    ),
    "an objective without its forces": FormulaMutation(
        [SPRINGS_SPEC, GRAVITY_SPEC],
        "objective (value)",
        patch_attribute(StepProblem, "evaluate_terms", drop_term("force")),
    ),
    "a gradient without the penalties": FormulaMutation(
        [SPRINGS_SPEC, PINS_SPEC],
        "objective (gradient)",
        patch_attribute(
            StepProblem, "gradient", lambda true: lambda self, p: true(self, p) * self.system.unpinned_mask[:, None]
        ),
    ),
}


@pytest.fixture(scope="module")
def unpatched_outcomes() -> dict[str, str]:
    """Outcomes without an error, by scene, size and integrator: many errors are planted in one scene."""
    return {}


@pytest.mark.parametrize("name", PLANTED_ERRORS)
def test_a_planted_error_is_found(name: str, unpatched_outcomes: dict[str, str], monkeypatch: pytest.MonkeyPatch):
    error = PLANTED_ERRORS[name]
    spec = build_scene_spec(*error.effects, mesh=error.mesh)
    compared = repr((spec, error.size, error.integrator))
    if compared not in unpatched_outcomes:
        unpatched_outcomes[compared] = run_reference_check(spec, error.size, error.integrator)
    assert unpatched_outcomes[compared] == "agrees"
    error.apply_patch(monkeypatch)
    found = run_reference_check(spec, error.size, error.integrator)
    assert found.startswith("disagrees: ")
    assert error.expected_words in found
