"""The second opinion agrees with every shipped scene, and tells every lie that is planted: in energies, forces, pins,
filters, integrators, masses and the objective itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array

from harness.base.model import Model
from harness.config.load import load_any, load_scene
from harness.experiments import run as runs
from harness.report.robustness import DISPUTED, RIGHT, judged
from harness.scenes import material
from harness.scenes.bind import Scene, build
from harness.scenes.effects.base import Contribution, Pin, Steady
from harness.scenes.effects.table import EFFECTS
from harness.scenes.mesh.base import Mesh
from harness.scenes.mesh.table import MESHES
from harness.scenes.motion import Motion
from harness.scenes.spec import SceneSpec
from harness.simulation.opinion.second import second_opinion
from solvers.contact.energy import Contact
from solvers.energies.attachments import Attachments
from solvers.energies.bending import Bending
from solvers.energies.dashpots import Dashpots, RayleighDashpots
from solvers.energies.gas import Gas
from solvers.energies.quadratic import AirDrag, Quadratic, RayleighDamping
from solvers.energies.springs import Springs
from solvers.energies.strain_limits import StrainLimits
from solvers.integrators import INTEGRATORS, Integrator
from solvers.problem import Energy, Positions, StepProblem, System
from solvers.registry import load

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SCENES = {path.stem: path for path in sorted((CONFIGS / "scenes").glob("*.yaml"))}
HARD = {path.stem: path for folder in ("hard", "hard-long") for path in sorted((CONFIGS / folder).glob("*.yaml"))}
METHODS = ("implicit-euler", "bdf2", "midpoint")
SIZES = {"pulled-curtain": 9}
"""Mesh sizes of scenes whose pins ask for them."""


def opinion(spec: SceneSpec, size: int = 0, integrator: str = "implicit-euler") -> str:
    return second_opinion(spec, build(spec, size, integrator), integrator)


@pytest.mark.parametrize("name", SCENES)
def test_both_opinions_agree_on_a_scene(name: str):
    spec = load_scene(SCENES[name])
    # A third of the size has the same formulas and takes a tenth of the time; the integrators take turns.
    size = SIZES.get(name) or max(getattr(spec.mesh, "SMALLEST", 2), (spec.default_size or 0) // 3)
    assert opinion(spec, size, METHODS[list(SCENES).index(name) % 3]) == "agrees"


@pytest.mark.parametrize("name", HARD)
def test_both_opinions_agree_on_a_hard_case(name: str):
    spec = load_scene(HARD[name])
    assert opinion(spec, spec.default_size or 0) == "agrees"


@pytest.mark.long
@pytest.mark.parametrize("integrator", METHODS)
@pytest.mark.parametrize("name", [*SCENES, *HARD])
def test_both_opinions_agree_with_every_integrator_at_full_size(name: str, integrator: str):
    spec = load_scene((SCENES | HARD)[name])
    assert opinion(spec, spec.default_size or 0, integrator) == "agrees"


MOVES = {"keys": [{"time": 0}, {"time": 0.4, "offset": (0.1, 0.2, 0), "turn": 90}, {"time": 1, "turn": 30}]}
SMOOTH = MOVES | {"between": "smooth", "axis": (1, 2, 0), "about": (0.1, 0, 0.3)}
OBSTACLES = [
    {"kind": "plane", "point": (0, -0.3, 0), "normal": (0.2, 1, 0)},
    {"kind": "sphere", "center": (0, -0.9, 0), "radius": 0.3, "motion": SMOOTH},
    {"kind": "capsule", "ends": [(0, -1, 0), (1, -1, 0.5)], "radius": 0.1, "motion": MOVES},
    {"kind": "box", "low": (-0.2, -2, -0.2), "high": (0.3, -1.7, 0.4), "motion": MOVES},
]
SPRINGS = {"kind": "springs", "stretch": 300, "shear": 60}
SKIP_ONE = {"kind": "springs", "stretch": 300, "shear": 60, "bend": 0.01}
PINS = {"kind": "pins", "at": ["top_corners"], "motion": SMOOTH}
TIED = {"kind": "attachments", "at": ["bottom"], "stiffness": 50, "motion": MOVES}
LIMITS = {"kind": "strain-limits", "longest": 1.02, "shortest": 0.98, "stiffness": 500}
GUSTS = {"kind": "wind", "field": "gusts", "per": "triangle", "velocity": (3, 0, 1), "lift": 0.5}
BEND, DASHPOTS = {"kind": "bending", "stiffness": 0.5}, {"kind": "dashpots", "stretch": 2}
RAYLEIGH = {"kind": "rayleigh", "mass": 0.5, "stiffness": 0.02}
DRAG, GRAVITY = {"kind": "air-drag", "coefficient": 2}, {"kind": "gravity"}
FLOOR = {"kind": "contact", "obstacles": OBSTACLES, "friction": 0.3, "creep": 0.01}
BLOWN = {"kind": "wind", "field": "assignment"}
FORCES = [GRAVITY, {"kind": "constant-force", "force": (0, 0, 0.1)}, BLOWN]
SLOWED = [{"kind": "ether-drag", "rate": 2}, {"kind": "air-drag", "law": "quadratic", "coefficient": 0.3}]
GAS = {"kind": "gas", "pressure": 200}


def declared(*effects: dict[str, Any], mesh: dict[str, Any] | None = None, **more: Any) -> SceneSpec:
    """A cloth (or another mesh) with effects, as a file declares them."""
    given = mesh or {"kind": "grid", "skip_one": True}
    made = tuple(load(EFFECTS[effect["kind"]]).model_validate(effect) for effect in effects)
    fields: dict[str, Any] = {"mass": 1.0, "time_step": 1 / 30, "frames": 40} | more
    return SceneSpec(mesh=load(MESHES[given["kind"]])(**given), effects=made, path=Path("scene.yaml"), **fields)


def scaled(**fields: float) -> Callable[[Any], Any]:
    """Energies with some fields multiplied."""
    return lambda energy: replace(energy, **{name: by * getattr(energy, name) for name, by in fields.items()})


class Lie(NamedTuple):
    """What is told: of the class of an energy, changed as they are bound; or by a patch. words: in what the opinion has
    to disagree."""

    effects: list[dict[str, Any]]
    words: str
    tell: Callable[[pytest.MonkeyPatch], None]
    integrator: str = "implicit-euler"
    mesh: dict[str, Any] | None = None
    size: int = 5


def bound(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Every energy of a class is changed when a scene is built."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        made = System.__init__

        def lying(self: System, mass: Any, time_step: float, energies: Any = (), *more: Any, **named: Any) -> None:
            told = tuple(change(one) if type(one) is kind else one for one in energies)
            made(self, mass, time_step, told, *more, **named)

        patch.setattr(System, "__init__", lying)

    return tell


def begun(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Every energy of a class is changed when a step begins."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        true = kind.begin_step
        patch.setattr(kind, "begin_step", lambda self, start: change(true(self, start)))

    return tell


def started(kind: type, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    """Every energy of a class begins its steps at another start."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        true = kind.begin_step
        patch.setattr(kind, "begin_step", lambda self, start: true(self, change(start)))

    return tell


def scales(kind: type, method: str, by: float) -> Callable[[pytest.MonkeyPatch], None]:
    """A method of a class returns so many times what it should, in its last argument where it adds to that."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        true = getattr(kind, method)

        def lying(self: Any, p: Positions, *out: Positions) -> Any:
            if not out:
                return by * true(self, p)
            added = np.zeros_like(out[0])
            true(self, p, added)
            out[0][:] += by * added
            return None

        patch.setattr(kind, method, lying)

    return tell


def contributed(target: str, change: Callable[[Contribution], Contribution]) -> Callable[[pytest.MonkeyPatch], None]:
    """An effect binds to something else."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        kind = load(EFFECTS[target])
        true = kind.bind
        patch.setattr(kind, "bind", lambda *given: change(true(*given)))

    return tell


def steady(by: float) -> Callable[[Contribution], Contribution]:
    def change(part: Contribution) -> Contribution:
        return replace(part, forces=tuple(Steady(by * one.force) for one in part.forces if isinstance(one, Steady)))

    return change


def blown(by: float) -> Callable[[Contribution], Contribution]:
    return lambda part: replace(part, forces=tuple(lambda p, v, t, one=one: by * one(p, v, t) for one in part.forces))


def pinned(**changes: Callable[[Pin], Any]) -> Callable[[Contribution], Contribution]:
    return lambda part: replace(
        part, pins=tuple(replace(pin, **{name: of(pin) for name, of in changes.items()}) for pin in part.pins)
    )


def filtered(by: float) -> Callable[[Contribution], Contribution]:
    return lambda part: replace(part, filters=tuple(lambda v, one=one: by * one(v) for one in part.filters))


def integrated(name: str, **changes: Any) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setitem(INTEGRATORS, name, replace(INTEGRATORS[name], **changes))


def predicted(name: str, target: float = 1.0, origin: float = 1.0) -> Callable[[pytest.MonkeyPatch], None]:
    """The target or the origin of an integrator, by how much of the way that it leads from the positions."""

    def tell(patch: pytest.MonkeyPatch) -> None:
        true = INTEGRATORS[name].predict

        def lying(now: Any, before: Any, dt: float) -> tuple[Positions, Positions]:
            p, (aim, began) = now.positions, true(now, before, dt)
            return p + target * (aim - p), p + origin * (began - p)

        integrated(name, predict=lying)(patch)

    return tell


def patched(where: Any, name: str, change: Callable[[Any], Any]) -> Callable[[pytest.MonkeyPatch], None]:
    return lambda patch: patch.setattr(where, name, change(getattr(where, name)))


def planes(**changes: Callable[[Any], Any]) -> Callable[[Contact], Contact]:
    """The half-spaces of a step, changed."""
    return lambda energy: replace(
        energy, planes=energy.planes._replace(**{name: of(energy.planes) for name, of in changes.items()})
    )


def leaves_out(word: str) -> Callable[[Any], Any]:
    """`StepProblem.terms` without a term."""
    return lambda true: lambda self, p: {name: value for name, value in true(self, p).items() if name != word}


BALL = {"kind": "balloon"}
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
        [SPRINGS, GAS], "gas (Hessian)", scales(Gas, "hessian", -1.0), mesh=BALL, size=2
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
    "friction that sticks half as long": Lie([SPRINGS, FLOOR], "contact", bound(Contact, scaled(slip=0.5))),
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
        patched(Motion, "_at", lambda true: lambda self, time: true(self, time) * [1, 1, 1, -1]),
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


@pytest.mark.parametrize("integrator", METHODS)
def test_both_opinions_agree_where_all_effects_are(integrator: str):
    every = [SKIP_ONE, PINS, TIED, LIMITS, GUSTS, BEND, DASHPOTS, RAYLEIGH, DRAG, FLOOR, *FORCES, *SLOWED]
    assert opinion(declared(*every, velocity=(0.1, 0.2, 0.3)), 5, integrator) == "agrees"
    gas = [SPRINGS, GAS, LIMITS, GUSTS, BEND, DASHPOTS, RAYLEIGH, DRAG, *FORCES]
    assert opinion(declared(*gas, mesh=BALL), 2, integrator) == "agrees"


def test_steps_of_two_lengths_are_compared(monkeypatch: pytest.MonkeyPatch):
    spec = declared(SPRINGS, PINS, DASHPOTS, FLOOR, *SLOWED, alternate_time_step=1 / 50)
    assert opinion(spec, 5) == "agrees"
    patched(Scene, "time", lambda true: lambda self, index: index * self.system.time_step)(monkeypatch)
    assert "times" in opinion(spec, 5)


class Well(Quadratic):
    """A well that draws every vertex to the origin; the name is that of no shipped energy."""


class Cone:
    """w |p| for each vertex: no function of complex numbers, for it takes lengths by `numpy.linalg.norm`."""

    def __init__(self, weight: float, told: float) -> None:
        self.weight, self.told = weight, told

    def value(self, p: Positions) -> float:
        return self.weight * float(np.linalg.norm(p, axis=1).sum())

    def add_gradient(self, p: Positions, out: Positions) -> None:
        out += self.told * p / np.linalg.norm(p, axis=1)[:, None]

    def hessian(self, p: Positions) -> csr_array:
        return csr_array((p.size, p.size))


class Outside(Model):
    """An effect that nobody but its author knows."""

    kind: Literal["magnet"] = "magnet"
    told: float = 3.0
    """The gradient in parts of what it should be, times 3."""
    shape: Literal["well", "cone"] = "well"

    def bind(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> Contribution:
        n = len(mass)
        well = Well(csr_array(np.eye(n)), np.full(n, 3.0), np.zeros((n, 3)))
        if self.told != 3.0:
            true = well.add_gradient
            object.__setattr__(well, "add_gradient", lambda p, out: scaled_sum(true, p, out, self.told / 3.0))
        energy: Energy = well if self.shape == "well" else Cone(3.0, self.told)
        return Contribution(
            energies=(energy,),
            forces=(lambda p, v, t: 0.1 * np.sin(p) - v + t,),
            filters=(lambda v: 0.99 * v,),
            pins=(Pin(np.array([0]), mesh.rest[:1], 1e5),),
        )


def scaled_sum(true: Callable[[Positions, Positions], None], p: Positions, out: Positions, by: float) -> None:
    added = np.zeros_like(out)
    true(p, added)
    out += by * added


@pytest.mark.parametrize("integrator", METHODS)
@pytest.mark.parametrize("shape", ["well", "cone"])
def test_an_effect_from_outside_is_held_against_its_own_value(shape: Any, integrator: str):
    spec = declared(SPRINGS, GRAVITY, FLOOR)
    known = spec.effects

    def asked(outside: Outside) -> str:
        return opinion(spec.model_copy(update={"effects": (*known, outside)}), 4, integrator)

    assert asked(Outside(shape=shape)) == "single opinion: effects[3] magnet"
    assert asked(Outside(shape=shape, told=3.003)).startswith(
        "disagrees: effects[3] magnet (gradient against its own value)"
    )


def test_an_effect_that_takes_a_known_name_is_from_outside():
    class Springs(Outside):
        kind: Literal["springs"] = "springs"  # pyright: ignore[reportIncompatibleVariableOverride]

    spec = declared(GRAVITY)
    spec = spec.model_copy(update={"effects": (*spec.effects, Springs())})
    assert opinion(spec, 4) == "single opinion: effects[1] springs"


def test_damping_of_what_comes_from_outside_has_no_second_opinion():
    spec = declared(SPRINGS, RAYLEIGH)
    spec = spec.model_copy(update={"effects": (*spec.effects, Outside())})
    assert opinion(spec, 4) == "single opinion: effects[1] rayleigh, effects[2] magnet"


SCENE = """mesh: {kind: grid}
mass: 1
time_step: 0.03
frames: 2
default_size: 4
effects: [{kind: gravity}, {kind: springs, stretch: 100}, {kind: bending, stiffness: 0.1}, {kind: pins, at: [left]}]
"""


def test_a_run_that_is_disputed_is_not_right(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "scene.yaml").write_text(SCENE)
    asked = {"tolerance": 1e-6, "rounds": 1, "judge": True, "record": False, "iterations": 200}
    newton, sparse = load_any(tmp_path / "scene.yaml", solvers=["newton", "sparse"], **asked).runs()
    times: list[str] = []

    def counted(*given: Any) -> str:
        times.append(second_opinion(*given))
        return times[-1]

    monkeypatch.setattr(runs, "second_opinion", counted)

    def rows_of(run: Any) -> list[dict[str, Any]]:
        files = runs.Files.of(run, tmp_path)
        files.rows.parent.mkdir(exist_ok=True)
        done = runs.execute(run, files, lambda phase: None)
        named = {"distance": None, "stationarity": None, "frame": None, "reason": None, "minimum": None}
        return [named | row for row in done if row["phase"] == "step"]

    runs._second_opinion.cache_clear()
    for run in (newton, sparse):
        done = rows_of(run)
        assert {(row["status"], row["second_opinion"]) for row in done} == {("ok", "agrees")}
    assert judged(rows_of(newton))[0] is RIGHT
    assert times == ["agrees"]  # once for the scene
    bound(Bending, scaled(weight=2.0))(monkeypatch)
    runs._second_opinion.cache_clear()
    done = rows_of(newton)
    assert {row["status"] for row in done} == {"disputed"}
    outcome, _, _, reason = judged(done)
    assert outcome is DISPUTED
    assert reason.startswith("the second opinion disagrees: effects[2] bending")
    runs._second_opinion.cache_clear()


def test_a_run_that_is_not_judged_asks_for_no_second_opinion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "scene.yaml").write_text(SCENE)
    monkeypatch.setattr(runs, "second_opinion", lambda *given: pytest.fail("was asked"))
    (run,) = load_any(tmp_path / "scene.yaml", solvers=["sparse"], rounds=1, record=False).runs()
    files = runs.Files.of(run, tmp_path)
    files.rows.parent.mkdir()
    assert {row["status"] for row in runs.execute(run, files, lambda phase: None)} == {"ok"}
