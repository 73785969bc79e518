"""Effects and meshes from plug-ins: named by a scene, imported where they are used.

A loaded scene contains `PluginEffect` and `PluginMesh`, which have only a name and parameters. `SceneSpec.load_plugins`
replaces them in the process that uses them. Results of plug-in code are checked, and error messages name the plug-in.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeGuard

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, SkipValidation
from springbench.harness.errors import InputError, InputMistake, SpringbenchError
from springbench.harness.execution.error_location import format_error, locate_error
from springbench.harness.scenes.effects.effect_interface import (
    ConstantForceField,
    EffectContribution,
    PinGroup,
    SceneEffect,
)
from springbench.harness.scenes.mesh import mesh_generator
from springbench.harness.scenes.mesh.mesh import BEND, SHEAR, STRETCH, Mesh
from springbench.harness.schema.base_model import ConfigModel
from springbench.harness.schema.config_document import ConfigDocument, ConfigKey
from springbench.solvers.model import integrators
from springbench.solvers.plugins.plugin_discovery import PluginName, load_target

IMPORT_NOTICE = "\0importing "
"""Prefix of the progress event, followed by the name of the plug-in, before its code is imported."""


def load_plugin(document: ConfigDocument, plugin: PluginName, part_kind: str, key: ConfigKey) -> Any:
    """Load a plug-in, which runs its code.

    Args:
        document: document that names it, which collects mistakes.
        plugin: name of the plug-in.
        part_kind: expected kind, a key of PLUGIN_KINDS.
        key: location in the document, for the mistakes.

    Returns:
        The class, function or object; None after a mistake was added.
    """
    expected, fits = PLUGIN_KINDS[part_kind]
    document.user_code.on_import(f"{IMPORT_NOTICE}{plugin}")
    try:
        with preserve_working_directory():
            made = load_target(plugin.import_target)
        problem = "" if fits(made) else f"is no {part_kind}; expected {expected}"
        if lacks := sorted(getattr(made, "__abstractmethods__", ())):
            problem = problem or f"has no method `{'`, `'.join(lacks)}`, which its base class requires"
    except AttributeError as error:
        missing = error.name == plugin.import_target.rpartition(":")[2] and error.obj is not None
        problem = (
            "cannot be loaded: "
            f"{f'{plugin.module_name} has no {error.name}' if missing else _describe_error(error, plugin)}"
        )
    except Exception as error:  # user code may raise any exception
        problem = f"cannot be loaded: {_describe_error(error, plugin)}"
    else:
        if not problem:
            return made
    document.add_mistake(f"{plugin} {problem}", key)
    return None


def build_plugin_part(
    document: ConfigDocument, plugin: PluginName, part_kind: str, parameters: dict[str, Any], key: ConfigKey
) -> Any:
    """Build an effect or a mesh from a plug-in class, which is imported.

    Args:
        document: document that names it, which collects mistakes.
        plugin: name of the plug-in.
        part_kind: "effect" or "mesh".
        parameters: values of the model's fields.
        key: location of the part in the document.

    Returns:
        The effect or mesh; None after mistakes were added.
    """
    model = load_plugin(document, plugin, part_kind, (*key, "kind"))
    if model is None:
        return None
    try:
        return document.validate_data(model, document.resolve_paths(model, parameters, key), key)
    except Exception as error:  # a validator may be user code, too
        document.add_mistake(f"{plugin} cannot be made of these parameters: {_describe_error(error, plugin)}", key)
        return None


def _describe_error(error: BaseException, plugin: PluginName) -> str:
    return f"{format_error(error)} ({locate_error(error, {plugin.source_path})})"


def _make_model_check(base: type[ConfigModel], method: str) -> Callable[[Any], bool]:
    return lambda made: isinstance(made, type) and issubclass(made, base) and callable(getattr(made, method, None))


def _is_valid_integrator(made: integrators.AnyIntegrator) -> bool:
    if not isinstance(made, integrators.SingleStageIntegrator):
        return True
    numbers: tuple[Any, ...] = made.inertia_factor, made.stage_fraction, made.extrapolation_fraction, made.order
    known = all(isinstance(one, float | int) and math.isfinite(one) for one in numbers)
    return known and made.inertia_factor > 0.0 and callable(made.predict_target)


PLUGIN_KINDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "solver": (
        "a frozen dataclass with a method `prepare`",
        lambda made: isinstance(made, type) and is_dataclass(made) and callable(getattr(made, "prepare", None)),
    ),
    "effect": (
        "a subclass of springbench.ConfigModel with a method `build_contribution` and a `kind`",
        lambda made: (
            _make_model_check(ConfigModel, "build_contribution")(made)
            and hasattr(made, "model_fields")
            and "kind" in made.model_fields
        ),
    ),
    "mesh": (
        "a subclass of springbench.MeshGenerator",
        _make_model_check(mesh_generator.MeshGenerator, "generate_mesh"),
    ),
    "report": ("a function of rows and a folder", callable),
    "integrator": (
        "an object of springbench.SingleStageIntegrator, RungeKutta or GeneralisedAlpha, of finite numbers, with "
        "`inertia_factor` above 0",
        lambda made: isinstance(made, integrators.AnyIntegrator) and _is_valid_integrator(made),
    ),
}
"""Kinds of plug-ins: description and check."""


@dataclass(frozen=True, slots=True)
class PluginEffect:
    """An effect by name and parameters; `folder` is that of the file that names it."""

    kind: PluginName
    parameters: Mapping[str, Any]
    folder: str

    def load_effect(self) -> SceneEffect:
        """Load the effect; raise InputError on failure."""
        return _load_part(self, "effect")

    def build_contribution(self, mesh: Mesh, mass: NDArray[np.float64], time_step: float) -> EffectContribution:
        """Build the effect's contribution from the loaded plug-in.

        Args:
            mesh: the mesh at rest.
            mass: vertex masses (n,) [kg].
            time_step: dt [s].

        Raises:
            InputError: the plug-in cannot be loaded, or does not accept its parameters.
        """
        return self.load_effect().build_contribution(mesh, mass, time_step)


class PluginMesh(mesh_generator.MeshGenerator):
    """A mesh by name and parameters; `folder` is that of the file that names it."""

    model_config = ConfigDict(arbitrary_types_allowed=True)

    kind: SkipValidation[PluginName]
    parameters: dict[str, Any]
    folder: str
    SIZE_MEANING: ClassVar[str] = "as its code says"
    SPRINGS_PER_VERTEX: ClassVar[int] = 1

    def load_mesh(self) -> mesh_generator.MeshGenerator:
        """Load the mesh; raise InputError on failure."""
        return _load_part(self, "mesh")

    def count_vertices(self, size: int) -> int:
        """Return the size, as the number of vertices is unknown."""
        return size

    def generate_mesh(self, size: int) -> Mesh:
        """Generate the mesh of a size; raise InputError on failure."""
        return self.load_mesh().build_mesh(size)


def _load_part(part: PluginEffect | PluginMesh, what: str) -> Any:
    document = ConfigDocument(Path(part.folder) / "scene.yaml", {})
    made = build_plugin_part(document, part.kind, what, dict(part.parameters), ())
    if made is None:
        raise InputError([InputMistake(mistake.problem, key=mistake.key) for mistake in document.mistakes])
    return made


@contextmanager
def preserve_working_directory() -> Generator[None]:
    """Restore the working directory on exit."""
    here = os.getcwd()
    try:
        yield
    finally:
        with suppress(OSError):
            os.chdir(here)


@contextmanager
def attribute_errors(plugin: PluginName, method_name: str) -> Generator[None]:
    """Turn exceptions of a plug-in into InputError with its name and line.

    The working directory is restored, too.

    Args:
        plugin: plug-in whose code runs in the context.
        method_name: name of the method or of the computed quantity, for the message.

    Raises:
        InputError: from any exception but MemoryError and those of the project, which are raised unchanged.
    """
    try:
        with preserve_working_directory():
            yield
    except (SpringbenchError, MemoryError):
        raise
    except Exception as error:
        raise InputError(f"{plugin}: `{method_name}` raised {_describe_error(error, plugin)}") from error


def build_checked_contribution(
    plugin: PluginName, effect: SceneEffect, mesh: Mesh, mass: NDArray[np.float64], time_step: float
) -> EffectContribution:
    """Build the contribution of a plug-in effect and check it.

    Args:
        plugin: the plug-in.
        effect: its effect.
        mesh: the mesh.
        mass: vertex masses (n,) [kg].
        time_step: dt [s].

    Raises:
        InputError: if the plug-in fails, or its contribution is invalid.
    """
    before = [array.tobytes() for array in _list_arrays(mesh, mass)]
    with attribute_errors(plugin, "build_contribution"):
        made: Any = effect.build_contribution(mesh, mass, time_step)
    if [array.tobytes() for array in _list_arrays(mesh, mass)] != before:
        raise InputError(
            f"{plugin}: `build_contribution` wrote to the mesh or the masses, which are inputs; change copies"
        )
    if not isinstance(made, EffectContribution):
        expected = "expected a springbench.harness.scenes.effects.effect_interface.EffectContribution"
        raise InputError(f"{plugin}: `build_contribution` returned {_describe_value(made)}; {expected}")
    with attribute_errors(plugin, "build_contribution"):
        for field in fields(made):
            _require_true(isinstance(getattr(made, field.name), tuple), f"`{field.name}` should be a tuple")
        for energy in made.energies:
            methods = [name for name in ("value", "add_gradient", "hessian") if not callable(getattr(energy, name, 0))]
            _require_true(not methods, f"the energy {type(energy).__name__} has no method `{', '.join(methods)}`")
        for pin in made.pins:
            _require_pin(pin, len(mesh.rest_positions))
        _require_true(all(map(callable, made.velocity_filters)), "`velocity_filters` should be functions of velocities")
        _require_true(all(map(callable, made.forces)), "`forces` should be functions of positions, velocities and time")
        for force in made.forces:
            if isinstance(force, ConstantForceField):
                _require_array(force.force, mesh.rest_positions.shape, "a constant force")
    n = len(mesh.rest_positions)
    forces = tuple(
        f if isinstance(f, ConstantForceField) else _CheckedFunction(f, plugin, "force [N]", n) for f in made.forces
    )
    return replace(
        made,
        forces=forces,
        velocity_filters=tuple(_CheckedFunction(f, plugin, "velocity [m/s]", n) for f in made.velocity_filters),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _CheckedFunction:
    """A force or filter of a plug-in with checked results."""

    function: Callable[..., Any]
    plugin: PluginName
    quantity: str
    num_vertices: int

    def __call__(self, *arguments: Any) -> Any:
        with attribute_errors(self.plugin, self.quantity.partition(" ")[0]):
            found: Any = self.function(*(one.copy() if _is_array(one) else one for one in arguments))
            expected = self.num_vertices, 3
            if not _is_array(found) or found.shape != expected:
                raise ValueError(f"gave {_describe_value(found)}; expected a {self.quantity} of shape {expected}")
        return found


def _is_array(value: object) -> TypeGuard[NDArray[Any]]:
    return isinstance(value, np.ndarray)


def _require_true(holds: bool, problem: str) -> None:
    if not holds:
        raise ValueError(problem)


def _require_array(array: Any, shape: tuple[int | None, ...], what: str, *, integers: bool = False) -> None:
    expected = f"{what} should be an array of {'integers' if integers else 'float64'} of shape "
    expected += f"({', '.join('any' if n is None else str(n) for n in shape)})"
    if (
        not _is_array(array)
        or array.ndim != len(shape)
        or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True))
        or not (array.dtype.kind == "i" if integers else array.dtype == np.float64)
    ):
        raise ValueError(f"{expected}, not {_describe_value(array)}")
    if not integers and not np.isfinite(array).all():
        raise ValueError(f"{what} has values that are not finite, the first at {np.argwhere(~np.isfinite(array))[0]}")


def _require_indices(array: Any, shape: tuple[int | None, ...], what: str, count: int) -> None:
    _require_array(array, shape, what, integers=True)
    if array.size and (array.min() < 0 or array.max() >= count):
        wrong = int(array[(array < 0) | (array >= count)][0])
        raise ValueError(f"{what} names {wrong}; there are {count}, counted from 0")


def _require_pin(pin: Any, count: int) -> None:
    _require_true(
        isinstance(pin, PinGroup),
        f"got {_describe_value(pin)} in `pins`; expected springbench.harness.scenes.effects.effect_interface.PinGroup",
    )
    _require_indices(pin.vertices, (None,), "`vertices` of a pin", count)
    _require_array(pin.targets, (len(pin.vertices), 3), "`targets` of a pin")
    weight = pin.weight
    _require_true(
        isinstance(weight, float | int) and weight > 0.0, f"`weight` of a pin is {weight!r}; it should be above 0"
    )


def check_plugin_mesh(plugin: PluginName, mesh: Any) -> Mesh:
    """Check a mesh from a plug-in, and return it.

    Args:
        plugin: the plug-in, for messages.
        mesh: result of its method `generate_mesh`, of any type.

    Raises:
        InputError: it is no `Mesh`, or an array of it has a wrong shape, type or value.
    """
    with attribute_errors(plugin, "generate_mesh"):
        _require_true(
            isinstance(mesh, Mesh),
            f"returned {_describe_value(mesh)}; expected a springbench.harness.scenes.mesh.mesh.Mesh",
        )
        _require_array(mesh.rest_positions, (None, 3), "`rest_positions`")
        n, m = len(mesh.rest_positions), len(mesh.springs)
        _require_true(n > 0, "`rest_positions` has no vertices")
        _require_indices(mesh.springs, (None, 2), "`springs`", n)
        _require_indices(mesh.triangles, (None, 3), "`triangles`", n)
        _require_array(mesh.mass_fractions, (n,), "`mass_fractions`")
        _require_true(bool((mesh.mass_fractions >= 0.0).all()), "`mass_fractions` has values below 0")
        _require_true(
            math.isclose(float(mesh.mass_fractions.sum()), 1.0, rel_tol=1e-6), "`mass_fractions` should sum to 1"
        )
        if unknown := mesh.spring_families.keys() - {STRETCH, SHEAR, BEND}:
            raise ValueError(
                f"`spring_families` has {sorted(map(str, unknown))[0]!r}; expected {STRETCH}, {SHEAR} and {BEND}"
            )
        for name, members in mesh.spring_families.items():
            _require_indices(members, (None,), f"`spring_families[{name!r}]`", m)
        listed = np.concatenate([*mesh.spring_families.values(), np.empty(0, np.int64)])
        _require_true(np.array_equal(np.sort(listed), np.arange(m)), "`spring_families` should have each spring once")
        for name, members in mesh.parts.items():
            _require_indices(members, (None,), f"`parts[{name!r}]`", n)
        if mesh.mass is not None:
            _require_array(mesh.mass, (n,), "`mass`")
            _require_true(bool((mesh.mass >= 0.0).all()), "`mass` has values below 0")
        for name, values in mesh.attributes.items():
            _require_array(values, (n,), f"`attributes[{name!r}]`")
        _require_true(mesh.dimension in (1, 2, 3), f"`dimension` is {mesh.dimension!r}; expected 1, 2 or 3")
        spacing: Any = mesh.spacing
        _require_true(isinstance(spacing, float | int) and 0.0 < spacing < math.inf, f"`spacing` is {spacing!r} m")
        if (same := mesh.springs[:, 0] == mesh.springs[:, 1]).any():
            raise ValueError(f"spring {np.flatnonzero(same)[0]} joins vertex {mesh.springs[same][0, 0]} to itself")
    return mesh


def _list_arrays(mesh: Mesh, mass: NDArray[np.float64]) -> list[NDArray[Any]]:
    arrays = [mesh.rest_positions, mesh.springs, mesh.triangles, mesh.mass_fractions, mass]
    return [*arrays, *mesh.spring_families.values(), *mesh.parts.values(), *mesh.attributes.values()]


def _describe_value(value: Any) -> str:
    if _is_array(value):
        return f"{value.dtype} of shape {value.shape}"
    return "None" if value is None else f"a {type(value).__name__}"
