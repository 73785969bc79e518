"""A validated scene specification."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol, cast

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, SkipValidation, ValidationInfo, WithJsonSchema

from harness.base.errors import InputError, Mistake, did_you_mean
from harness.base.model import Model
from harness.scenes.effects.base import Effect
from harness.scenes.mesh.base import Mesh
from harness.scenes.mesh.generator import MAX_VERTICES
from harness.scenes.own import OwnEffect, OwnMesh
from harness.scenes.start import AnyStart
from solvers import integrators, plugins
from solvers.plugins import Plugin, Table

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
"""Pattern of the names of scenes and sweeps; they become file names in the results."""

FirstGuess = Literal["assignment", "current", "inertial", "motion", "coarse"]


def named_in(table: Table) -> Any:
    """Return the type of a registered name or a plug-in (see `solvers.plugins`).

    The validation context provides the folder of the config.
    """

    def checked(value: str, info: ValidationInfo) -> str:
        name = table.named(value, Path(cast(Mapping[str, Any], info.context or {}).get("folder", ".")))
        if name not in table:
            raise ValueError(f"came {json.dumps(value)[:60]}; should be {did_you_mean(value, table)}")
        return name

    shipped = [name for one in table.shipped for name in one]
    schema = {"anyOf": [{"enum": shipped, "type": "string"}, {"pattern": plugins.PATTERN, "type": "string"}]}
    return Annotated[str, AfterValidator(checked), WithJsonSchema(schema)]


if TYPE_CHECKING:
    IntegratorName = str
else:
    IntegratorName = named_in(integrators.EVERY)


def _seconds(value: Any) -> Any:
    """Convert a fraction such as "1/30" to a number."""
    if not isinstance(value, str):
        return value
    try:
        return float(Fraction(value))
    except (ValueError, ZeroDivisionError, OverflowError) as error:
        raise ValueError(f'should be a number or a fraction such as "1/30", not {value[:40]!r}') from error


TimeStep = Annotated[
    float,
    Field(ge=1e-9, le=1e3),
    BeforeValidator(_seconds),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "number", "minimum": 1e-9, "maximum": 1e3},
                {"type": "string", "pattern": r"^[0-9]+(/[0-9]+)?$"},
            ]
        }
    ),
]
Speed = Annotated[float, Field(ge=-1e6, le=1e6)]
Size = Annotated[int, Field(ge=2, le=MAX_VERTICES)]
Frames = Annotated[int, Field(ge=1, le=1_000_000)]


class Camera(Model):
    """View direction of pictures; the camera aims at the centre of the mesh."""

    azimuth: float = Field(default=0.0, ge=-360, le=360)
    """Angle about the vertical axis [degrees], 0 is a view along -z."""
    elevation: float = Field(default=0.0, ge=-90, le=90)
    """Angle above the horizon [degrees]."""


class SceneFields(Model):
    """Fields of a scene that are the same in its file and in memory."""

    description: str = Field(default="", max_length=1000)
    """Description of the scene in one sentence."""
    mass: float | None = Field(default=None, gt=0, le=1e12)
    """Total mass [kg]; optional if the mesh provides masses."""
    mass_per_area: float | None = Field(default=None, gt=0, le=1e12)
    """Area density of the mesh's triangles at rest [kg/m^2], instead of `mass`."""
    time_step: TimeStep
    """Time step [s], a number or a fraction such as "1/30"."""
    alternate_time_step: TimeStep | None = None
    """Time step [s] of every second step; equal to `time_step` by default."""
    frames: Frames
    """Number of steps to simulate."""
    velocity: tuple[Speed, Speed, Speed] = (0.0, 0.0, 0.0)
    """Initial velocity of every vertex [m/s]."""
    start: AnyStart | None = None
    """Deviation of the initial state from the rest state."""
    default_size: Size | None = None
    """Mesh size if neither a sweep nor the command line gives sizes."""
    camera: Camera | None = None
    """View direction of pictures; chosen from the shape of the mesh by default."""


class SceneFile(SceneFields):
    """A scene: a mesh, its mass and time step, and the effects that act on it."""

    mesh: Any  # checked, like the effects, by the class that its kind names
    """The mesh; `kind` selects its type."""
    effects: Any = ()
    """Effects on the mesh; only listed effects are simulated."""


class MeshSource(Protocol):
    """A mesh as declared by a scene: a pydantic model with a literal `kind`."""

    def build(self, size: int) -> Mesh:
        """Build the mesh of a size; raise InputError if that size is not supported."""
        ...


class SceneSpec(SceneFields):
    """A validated scene."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    mesh: SkipValidation[MeshSource]
    """The mesh; `kind` selects its type."""
    mesh_digest: str = ""
    """SHA-256 of a mesh from a file; empty for a generated mesh, which its parameters and size determine."""
    effects: SkipValidation[tuple[Effect, ...]] = ()
    """Effects on the mesh; only listed effects are simulated."""
    first_guess: FirstGuess = "current"
    """Initial guess of a step unless a sweep sets it; see `guess`."""
    path: Path
    """Source file of the scene, for messages."""
    own: SkipValidation[Mapping[str, tuple[Plugin, Mapping[str, Any]]]] = Field(default_factory=dict)
    """Plug-ins by location (`mesh`, `effects[0]`, ...), with the parameters from the scene file."""
    lines: SkipValidation[Mapping[str, int]] = Field(default_factory=dict)
    """Line numbers of the keys in that file, for messages."""

    def guess(self, integrator: str) -> FirstGuess:
        """Return the default initial guess for an integrator: extrapolated for multi-stage integrators."""
        method = integrators.INTEGRATORS.get(integrator, integrators.IMPLICIT_EULER)
        says = self.first_guess != "current" or isinstance(method, integrators.Integrator)
        return self.first_guess if says else "motion"

    def of_effects(self, chosen: Sequence[int]) -> dict[str, Any]:
        """Return the fields `effects` and `plugins` of the scene restricted to effects with these indices."""
        own = {place: told for place, told in self.own.items() if place == "mesh"}
        places = {f"effects[{i}]": f"effects[{k}]" for k, i in enumerate(chosen)}
        own |= {places[place]: told for place, told in self.own.items() if place in places}
        return {"effects": tuple(self.effects[i] for i in chosen), "own": own}

    def opened(self) -> SceneSpec:
        """Return the scene with plug-ins loaded, which imports their code; raise InputError on failure."""
        parts = (self.mesh, *self.effects)
        if not any(isinstance(part, OwnEffect | OwnMesh) for part in parts):
            return self
        made = [_opened(part, f"effects[{i}]" if i >= 0 else "mesh") for i, part in enumerate(parts, -1)]
        values: dict[str, Any] = {key: getattr(self, key) for key in SceneSpec.model_fields}
        return SceneSpec.model_construct(None, **values | {"mesh": made[0], "effects": tuple(made[1:])})

    def stepped(self, time_step: float) -> SceneSpec:
        """Return the scene with another time step [s], the same for all steps."""
        if time_step == self.time_step:
            return self
        values: dict[str, Any] = {key: getattr(self, key) for key in SceneSpec.model_fields}
        return SceneSpec.model_construct(None, **values | {"time_step": time_step, "alternate_time_step": None})

    def require_even_steps(self) -> None:
        """Raise InputError if the steps differ in length."""
        if self.alternate_time_step is not None:
            key, wanted = "alternate_time_step", "what is measured here depends on one time step; leave it out"
            raise InputError(Mistake(wanted, self.path, self.lines.get(key), key))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything that determines a run; mesh files count by content, not by name."""
        content = self.model_dump(mode="json", include={"mass", "time_step", "velocity", "camera", "mesh", "effects"})
        content["mesh"] = self.mesh_digest or content["mesh"]
        for place, (plugin, given) in self.own.items():  # which need not be imported to be told apart
            told = [plugin.identity(), dict(given)]
            if place == "mesh":
                content["mesh"] = told
            else:
                content["effects"][int(place[len("effects[") : -1])] = told
        if self.start:
            content["start"] = self.start.model_dump(mode="json")
        if self.mass_per_area is not None:
            content["mass_per_area"] = self.mass_per_area
        if self.alternate_time_step is not None:
            content["alternate_time_step"] = self.alternate_time_step
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _opened(part: Any, at: str) -> Any:
    if not isinstance(part, OwnEffect | OwnMesh):
        return part
    try:
        return part.opened()
    except InputError as error:
        found = [replace(one, key=".".join(filter(None, [at, one.key]))) for one in error.mistakes]
        raise InputError(found) from error
