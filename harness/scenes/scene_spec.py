"""Models of a scene: the fields of its file, and the validated specification."""

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
from springbench.harness.errors import InputError, InputMistake, format_allowed_names
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.fabric_table import FabricChoice, FabricName
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.harness.scenes.mesh.mesh_generator import MAX_VERTICES
from springbench.harness.scenes.scene_plugins import PluginEffect, PluginMesh
from springbench.harness.scenes.start_positions import AnyStart
from springbench.harness.schema.base_model import ConfigModel
from springbench.solvers.model import integrators
from springbench.solvers.plugins import plugin_discovery
from springbench.solvers.plugins.plugin_discovery import PluginName, PluginTable

NAME_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
"""Pattern of the names of scenes and sweeps; they become file names in the results."""

InitialGuess = Literal["assignment", "previous", "inertial", "extrapolated", "coarse-to-fine"]


def build_name_type(table: PluginTable) -> Any:
    """Return the type of the names in a table, including those of plug-ins.

    The validation context provides the folder of the config
    (`springbench.solvers.plugins.plugin_discovery.PluginTable.resolve_name`).
    """

    def check_name(value: str, info: ValidationInfo) -> str:
        name = table.resolve_name(value, Path(cast(Mapping[str, Any], info.context or {}).get("folder", ".")))
        if name not in table:
            raise ValueError(f"got {json.dumps(value)[:60]}; should be {format_allowed_names(value, table)}")
        return name

    shipped = [name for one in table.builtin_tables for name in one]
    schema = {
        "anyOf": [{"enum": shipped, "type": "string"}, {"pattern": plugin_discovery.PLUGIN_PATTERN, "type": "string"}]
    }
    return Annotated[str, AfterValidator(check_name), WithJsonSchema(schema)]


if TYPE_CHECKING:
    IntegratorName = str
else:
    IntegratorName = build_name_type(integrators.INTEGRATOR_TABLE)


def _parse_seconds(value: Any) -> Any:
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
    BeforeValidator(_parse_seconds),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "number", "minimum": 1e-9, "maximum": 1e3},
                {"type": "string", "pattern": r"^[0-9]+(/[0-9]+)?$"},
            ]
        }
    ),
]
SpeedComponent = Annotated[float, Field(ge=-1e6, le=1e6)]
MeshSize = Annotated[int, Field(ge=2, le=MAX_VERTICES)]
FrameCount = Annotated[int, Field(ge=1, le=1_000_000)]


class CameraView(ConfigModel):
    """View direction of pictures; the camera aims at the centre of the mesh."""

    azimuth: float = Field(default=0.0, ge=-360, le=360)
    """Angle about the vertical axis [degrees], 0 is a view along -z."""
    elevation: float = Field(default=0.0, ge=-90, le=90)
    """Angle above the horizon [degrees]."""


class SceneFields(ConfigModel):
    """Fields of a scene that are the same in its file and in memory."""

    description: str = Field(default="", max_length=1000)
    """Description of the scene in one sentence."""
    mass: float | None = Field(default=None, gt=0, le=1e12)
    """Total mass [kg]; optional if the mesh provides masses."""
    mass_per_area: float | None = Field(default=None, gt=0, le=1e12)
    """Area density of the mesh's triangles at rest [kg/m^2], instead of `mass`."""
    fabric: FabricName | FabricChoice | None = None
    """A published fabric, by its name, or `{name: NAME, warp: [x, y, z]}`. It provides the mass per area, the membrane
    stiffness of `springs` and the flexural rigidity of `bending` that the scene does not state."""
    time_step: TimeStep
    """Time step [s], a number or a fraction such as "1/30"."""
    alternate_time_step: TimeStep | None = None
    """Time step [s] of every second step; equal to `time_step` by default."""
    frames: FrameCount
    """Number of steps to simulate."""
    velocity: tuple[SpeedComponent, SpeedComponent, SpeedComponent] = (0.0, 0.0, 0.0)
    """Initial velocity of every vertex [m/s]."""
    start: AnyStart | None = None
    """Deviation of the initial state from the rest state."""
    default_size: MeshSize | None = None
    """Mesh size if neither a sweep nor the command line gives sizes."""
    camera: CameraView | None = None
    """View direction of pictures; chosen from the shape of the mesh by default."""


class SceneFile(SceneFields):
    """A scene: a mesh, its mass and time step, and the effects on it."""

    mesh: Any  # checked, like the effects, by the class that its kind names
    """The mesh; `kind` selects its type."""
    effects: Any = ()
    """Effects on the mesh; only listed effects are simulated."""


class MeshSource(Protocol):
    """A mesh as declared by a scene: a pydantic model with a literal `kind`."""

    def build_mesh(self, size: int) -> Mesh:
        """Build the mesh of a size; raise InputError if that size is not supported."""
        ...


class SceneSpec(SceneFields):
    """A validated scene."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    mesh: SkipValidation[MeshSource]
    """The mesh; `kind` selects its type."""
    mesh_digest: str = ""
    """SHA-256 of a mesh from a file; empty for a generated mesh, which its parameters and size determine."""
    effects: SkipValidation[tuple[SceneEffect, ...]] = ()
    """Effects on the mesh; only listed effects are simulated."""
    initial_guess: InitialGuess = "previous"
    """Initial guess of a step unless a sweep sets it; integrators with several stages extrapolate by default."""
    barrier_time_step: float | None = None
    """Time step [s] of the file where the scene has another one: default barrier stiffnesses are derived from it."""
    path: Path
    """Source file of the scene, for messages."""
    plugins: SkipValidation[Mapping[str, tuple[PluginName, Mapping[str, Any]]]] = Field(default_factory=dict)
    """Plug-ins by location (`mesh`, `effects[0]`, ...), with the parameters from the scene file."""
    key_lines: SkipValidation[Mapping[str, int]] = Field(default_factory=dict)
    """Line numbers of the keys in that file, for messages."""

    def choose_initial_guess(self, integrator: str) -> InitialGuess:
        """Return the initial guess of the scene for an integrator.

        It is `extrapolated` instead of `previous` for integrators that evaluate forces at their stages.
        """
        method = integrators.INTEGRATORS.get(integrator, integrators.IMPLICIT_EULER)
        says = self.initial_guess != "previous" or isinstance(method, integrators.SingleStageIntegrator)
        return self.initial_guess if says else "extrapolated"

    def select_effect_fields(self, effect_indices: Sequence[int]) -> dict[str, Any]:
        """Return the fields `effects` and `plugins`, restricted to the effects with these indices."""
        plugins = {place: plugin for place, plugin in self.plugins.items() if place == "mesh"}
        places = {f"effects[{i}]": f"effects[{k}]" for k, i in enumerate(effect_indices)}
        plugins |= {places[place]: plugin for place, plugin in self.plugins.items() if place in places}
        return {"effects": tuple(self.effects[i] for i in effect_indices), "plugins": plugins}

    def find_plugins(self) -> list[PluginName]:
        """Find the user code of the scene: mesh and effects."""
        return [plugin for plugin, _ in self.plugins.values()]

    def load_plugins(self) -> SceneSpec:
        """Return the scene with plug-ins loaded, which imports their code; raise InputError on failure."""
        parts = (self.mesh, *self.effects)
        if not any(isinstance(part, PluginEffect | PluginMesh) for part in parts):
            return self
        made = [_load_part(part, f"effects[{i}]" if i >= 0 else "mesh") for i, part in enumerate(parts, -1)]
        values: dict[str, Any] = {key: getattr(self, key) for key in SceneSpec.model_fields}
        return SceneSpec.model_construct(None, **values | {"mesh": made[0], "effects": tuple(made[1:])})

    def with_time_step(self, time_step: float) -> SceneSpec:
        """Return the scene with another time step [s], the same for all steps.

        Barriers of default stiffness retain that of the declared time step. If the stiffness grew with 1/dt^2, shorter
        steps would never resolve an impact.
        """
        if time_step == self.time_step:
            return self
        values: dict[str, Any] = {key: getattr(self, key) for key in SceneSpec.model_fields}
        values |= {"time_step": time_step, "alternate_time_step": None}
        if any(map(_has_default_barrier, self.effects)):
            declared = self.barrier_time_step or self.time_step
            values["barrier_time_step"] = None if time_step == declared else declared
        return SceneSpec.model_construct(None, **values)

    def find_effect_time_step(self, effect: SceneEffect) -> float:
        """Return the time step [s] from which an effect derives its parameters."""
        return self.barrier_time_step if self.barrier_time_step and _has_default_barrier(effect) else self.time_step

    def require_fixed_time_step(self) -> None:
        """Raise InputError if the steps differ in length."""
        if self.alternate_time_step is not None:
            key, expected = "alternate_time_step", "what is measured here depends on one time step; leave it out"
            raise InputError(InputMistake(expected, self.path, self.key_lines.get(key), key))

    @cached_property
    def scene_digest(self) -> str:
        """SHA-256 of everything that determines a run; mesh files count by content, not by name."""
        content = self.model_dump(mode="json", include={"mass", "time_step", "velocity", "camera", "mesh", "effects"})
        content["mesh"] = self.mesh_digest or content["mesh"]
        for place, (plugin, given) in self.plugins.items():  # identified without an import
            identity = [plugin.identify_code(), dict(given)]
            if place == "mesh":
                content["mesh"] = identity
            else:
                content["effects"][int(place[len("effects[") : -1])] = identity
        if self.start:
            content["start"] = self.start.model_dump(mode="json")
        if self.mass_per_area is not None:
            content["mass_per_area"] = self.mass_per_area
        if self.alternate_time_step is not None:
            content["alternate_time_step"] = self.alternate_time_step
        if self.barrier_time_step is not None:
            content["barrier_time_step"] = self.barrier_time_step
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _has_default_barrier(effect: SceneEffect) -> bool:
    return getattr(effect, "barrier_stiffness", 0.0) is None


def _load_part(part: Any, at: str) -> Any:
    if not isinstance(part, PluginEffect | PluginMesh):
        return part
    try:
        return part.load_effect() if isinstance(part, PluginEffect) else part.load_mesh()
    except InputError as error:
        found = [replace(one, key=".".join(filter(None, [at, one.key]))) for one in error.mistakes]
        raise InputError(found) from error
