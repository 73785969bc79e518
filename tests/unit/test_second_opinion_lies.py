"""The second opinion tells every lie that is planted: in energies, forces, pins, filters, integrators, masses and the
objective itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from harness.scenes import material
from harness.scenes.bind import Scene
from harness.scenes.motion import KeyedMotion
from solvers.contact.energy import Contact
from solvers.energies.attachments import Attachments
from solvers.energies.bending import Bending
from solvers.energies.dashpots import Dashpots, RayleighDashpots
from solvers.energies.gas import Gas
from solvers.energies.quadratic import AirDrag, RayleighDamping
from solvers.energies.springs import Springs
from solvers.energies.strain_limits import StrainLimits
from solvers.integrators import Integrator
from solvers.problem import StepProblem, System
from tests.lies import (
    BALL,
    BEND,
    DASHPOTS,
    DRAG,
    FLOOR,
    FORCES,
    GAS,
    GRAVITY,
    GUSTS,
    LIMITS,
    PINS,
    RAYLEIGH,
    SKIP_ONE,
    SLOWED,
    SPRINGS,
    TIED,
    Lie,
    begun,
    blown,
    bound,
    contributed,
    declared,
    filtered,
    integrated,
    leaves_out,
    opinion,
    patched,
    pinned,
    planes,
    predicted,
    scaled,
    scales,
    started,
    steady,
)

PER_VERTEX = {"kind": "wind", "field": "constant", "per": "vertex", "force": (1, 0, 2)}
LIES: dict[str, Lie] = {
    "springs twice as stiff": Lie([SPRINGS], "springs", bound(Springs, scaled(stiffness=2.0))),
    "springs a millionth longer": Lie([SPRINGS], "springs", bound(Springs, scaled(rest_length=1.0 + 1e-6))),
    "springs' value alone": Lie([SPRINGS], "springs (value)", scales(Springs, "value", 1.0001)),
    "springs' gradient alone": Lie([SPRINGS], "springs (gradient)", scales(Springs, "add_gradient", 1.0001)),
    "springs' Hessian alone": Lie([SPRINGS], "springs (Hessian)", scales(Springs, "hessian", 1.01)),
    "skip-one springs that stiffen the cloth": Lie(
        [SKIP_ONE], "springs", patched(material, "_relieved", lambda true: lambda mesh, k: k)
    ),
    "limits that are wider": Lie([SPRINGS, LIMITS], "strain-limits", bound(StrainLimits, scaled(high=1.01))),
    "limits half as stiff": Lie([SPRINGS, LIMITS], "strain-limits", bound(StrainLimits, scaled(stiffness=0.5))),
    "dashpots twice as strong": Lie([SPRINGS, DASHPOTS], "dashpots", bound(Dashpots, scaled(stiffness=2.0))),
    "dashpots along the rest shape": Lie(
        [SPRINGS, DASHPOTS],
        "dashpots",
        patched(
            Dashpots,
            "begin_step",
            lambda true: lambda self, start: replace(true(self, start), direction=self.direction),
        ),
    ),
    "dashpots that damp motion to where it began": Lie(
        [SPRINGS, DASHPOTS], "dashpots", begun(Dashpots, scaled(offset=0.0))
    ),
    "damping by stiffness at another rate": Lie(
        [SPRINGS, RAYLEIGH], "rayleigh", started(RayleighDashpots, lambda start: replace(start, rate=1.1 * start.rate))
    ),
    "damping by mass": Lie([SPRINGS, RAYLEIGH], "rayleigh", bound(RayleighDamping, scaled(weight=1.01))),
    "bending with the other sign": Lie([SPRINGS, BEND], "bending", bound(Bending, scaled(weight=-1.0))),
    "bending with areas of one triangle": Lie([SPRINGS, BEND], "bending", bound(Bending, scaled(weight=2.0))),
    "bending with wrong cotangents": Lie(
        [SPRINGS, BEND], "bending", bound(Bending, lambda one: replace(one, A=csr_array(abs(one.A))))
    ),
    "gas of twice the volume": Lie([SPRINGS, GAS], "gas", bound(Gas, scaled(volume=2.0)), mesh=BALL, size=2),
    "gas that pulls": Lie([SPRINGS, GAS], "gas (gradient)", scales(Gas, "add_gradient", -1.0), mesh=BALL, size=2),
    "gas's Hessian without its sign": Lie(
        [SPRINGS, GAS], "gas (Hessian)", scales(Gas, "sparse_hessian", -1.0), mesh=BALL, size=2
    ),
    "attachments ten times as stiff": Lie([SPRINGS, TIED], "attachments", bound(Attachments, scaled(weight=10.0))),
    "attachments where the points were": Lie(
        [SPRINGS, TIED], "attachments", started(Attachments, lambda start: replace(start, until=start.time))
    ),
    "drag without its rate": Lie([SPRINGS, DRAG], "air-drag", begun(AirDrag, scaled(weight=1 / 30))),
    "drag towards where the step starts, not its origin": Lie(
        [SPRINGS, DRAG],
        "air-drag",
        started(AirDrag, lambda start: replace(start, origin=start.positions)),
        integrator="bdf2",
    ),
    "friction at .9": Lie([SPRINGS, FLOOR], "contact", bound(Contact, scaled(friction=0.9))),
    "friction of the step's start": Lie(
        [SPRINGS, FLOOR], "friction's pressure", bound(Contact, lambda one: replace(one, friction_rounds=1))
    ),
    "friction that sticks half as long": Lie([SPRINGS, FLOOR], "contact", bound(Contact, scaled(creep=0.5))),
    "contact half as stiff": Lie([SPRINGS, FLOOR], "contact", bound(Contact, scaled(stiffness=0.5))),
    "contact a little thicker": Lie([SPRINGS, FLOOR], "contact", bound(Contact, scaled(thickness=1.01))),
    "half-spaces a micrometre too high": Lie(
        [SPRINGS, FLOOR], "contact", begun(Contact, planes(offset=lambda found: found.offset + 1e-6))
    ),
    "friction against a floor that moves": Lie(
        [SPRINGS, FLOOR], "contact", begun(Contact, planes(anchor=lambda found: found.anchor + 1e-5))
    ),
    "contact's normals tilted": Lie(
        [SPRINGS, FLOOR], "contact", begun(Contact, planes(normal=lambda found: np.roll(found.normal, 1, axis=1)))
    ),
    "contact at the step's end for midpoint": Lie(
        [SPRINGS, FLOOR],
        "contact",
        started(Contact, lambda start: replace(start, until=2 * start.until - start.time)),
        integrator="midpoint",
    ),
    "gravity of the moon": Lie([SPRINGS, *FORCES], "forces", contributed("gravity", steady(0.165))),
    "gravity upwards": Lie([SPRINGS, GRAVITY], "forces", contributed("gravity", steady(-1.0))),
    "a force that is not shared": Lie([SPRINGS, *FORCES], "forces", contributed("constant-force", steady(1.001))),
    "wind a little stronger": Lie([SPRINGS, *FORCES], "forces", contributed("wind", blown(1.0 + 1e-9))),
    "a steady wind the other way": Lie([SPRINGS, PER_VERTEX], "forces", contributed("wind", steady(-1.0))),
    "gusts a little weaker on triangles": Lie([SPRINGS, GUSTS], "forces", contributed("wind", blown(1.0 - 1e-6))),
    "forces of the step's start for BDF2": Lie([SPRINGS, *FORCES], "forces", integrated("bdf2", ahead=0.0), "bdf2"),
    "ether drag twice": Lie([SPRINGS, *SLOWED], "inertial target", contributed("ether-drag", filtered(0.9))),
    "quadratic drag": Lie([SPRINGS, *SLOWED], "inertial target", contributed("air-drag", filtered(1.0 + 1e-9))),
    "pins that are held elsewhere": Lie(
        [SPRINGS, PINS], "targets of pins", contributed("pins", pinned(targets=lambda pin: pin.targets + 1e-6))
    ),
    "pins that stand still": Lie(
        [SPRINGS, PINS], "targets of pins", contributed("pins", pinned(motion=lambda pin: None))
    ),
    "pins with another weight": Lie(
        [SPRINGS, PINS], "weights of pins", contributed("pins", pinned(weight=lambda pin: 2 * pin.weight))
    ),
    "other pins": Lie(
        [SPRINGS, PINS], "pinned vertices", contributed("pins", pinned(vertices=lambda pin: pin.vertices + 1))
    ),
    "pins of the step's start": Lie(
        [SPRINGS, PINS],
        "targets of pins",
        patched(Scene, "pins_at", lambda true: lambda self, time: true(self, time - self.system.time_step)),
    ),
    "key frames that turn the other way": Lie(
        [SPRINGS, PINS],
        "targets of pins",
        patched(KeyedMotion, "_at", lambda true: lambda self, time: true(self, time) * [1, 1, 1, -1]),
    ),
    "implicit Euler that goes too far": Lie(
        [SPRINGS], "inertial target", predicted("implicit-euler", target=1.0 + 1e-6)
    ),
    "BDF2 with another coefficient": Lie([SPRINGS], "inertia", integrated("bdf2", factor=2.2), "bdf2"),
    "BDF2 with another target": Lie([SPRINGS], "inertial target", predicted("bdf2", target=1.001), "bdf2"),
    "BDF2 with another origin": Lie([SPRINGS], "origin of velocities", predicted("bdf2", origin=0.75), "bdf2"),
    "BDF2 without its history": Lie([SPRINGS], "inertial target", integrated("bdf2", history=False), "bdf2"),
    "midpoint with another coefficient": Lie([SPRINGS], "inertia", integrated("midpoint", factor=2.0), "midpoint"),
    "midpoint that ends in the middle": Lie(
        [SPRINGS], "positions after the step", integrated("midpoint", when=1.0), "midpoint"
    ),
    "midpoint with another target": Lie([SPRINGS], "inertial target", predicted("midpoint", target=2.0), "midpoint"),
    "velocities that are too fast": Lie(
        [SPRINGS],
        "velocities after the step",
        patched(
            Integrator,
            "advance",
            lambda true: lambda *given: (after := true(*given))._replace(velocity=1.001 * after.velocity),
        ),
    ),
    "a heavier cloth": Lie(
        [SPRINGS],
        "masses",
        patched(System, "__init__", lambda true: lambda self, mass, *more: true(self, 1.01 * mass, *more)),
    ),
    "an objective without its inertia": Lie(
        [SPRINGS], "objective (value)", patched(StepProblem, "terms", leaves_out("inertia"))
    ),
    "an objective without an energy": Lie(
        [SPRINGS, BEND], "objective (value)", patched(StepProblem, "terms", leaves_out("bending"))
    ),
    "an objective without its forces": Lie(
        [SPRINGS, GRAVITY], "objective (value)", patched(StepProblem, "terms", leaves_out("force"))
    ),
    "a gradient without the penalties": Lie(
        [SPRINGS, PINS],
        "objective (gradient)",
        patched(StepProblem, "gradient", lambda true: lambda self, p: true(self, p) * self.system.unpinned[:, None]),
    ),
}


@pytest.mark.parametrize("name", LIES)
def test_a_lie_is_told(name: str, monkeypatch: pytest.MonkeyPatch):
    lie = LIES[name]
    spec = declared(*lie.effects, mesh=lie.mesh)
    assert opinion(spec, lie.size, lie.integrator) == "agrees"
    lie.tell(monkeypatch)
    found = opinion(spec, lie.size, lie.integrator)
    assert found.startswith("disagrees: ")
    assert lie.words in found
