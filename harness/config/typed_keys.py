"""Types of the names and keys of configs written in Python, for type checkers.

They repeat the names and keys of the models; a test compares both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NewType, Required, TypedDict, TypeVar

from springbench.harness.scenes.scene_spec import InitialGuess

SolverName = Literal[
    "dense", "sparse", "numba", "anderson", "chebyshev", "lbfgs", "newton", "newton-cg", "hybrid", "xpbd",
    "xpbd-small-steps", "vbd", "vbd-ogc", "symplectic-euler", "velocity-verlet", "blanes-moan-4", "blanes-moan-6",
    "runge-kutta-4", "tsitouras-5", "dormand-prince-8", "baraff-witkin", "ros2", "ros3p", "rodas", "pncg", "admm",
    "a-jacobi", "mgpbd", "jgs2", "avbd", "eigen", "cholmod", "mujoco", "pypbd", "taichi", "newton-physics",
]  # fmt: skip
"""Names of the shipped solvers."""
IntegratorName = Literal[
    "implicit-euler", "bdf2", "midpoint", "generalised-alpha", "hht", "newmark", "sdirk-2", "tr-bdf2", "sdirk-3",
    "esdirk-3", "sdirk-4", "esdirk-4", "substepping",
]  # fmt: skip
"""Names of the shipped integrators."""
ReportName = Literal["certificates", "medians", "timing"]
UserCodeName = NewType("UserCodeName", str)
"""Name of user code: `UserCodeName("./mine.py:Mine")`."""

T = TypeVar("T")
OneOrSequence = T | Sequence[T]
NumberOrText = float | str
"""A number, or a fraction such as "1/30"."""


class SceneKeys(TypedDict, total=False):
    """Keys of a scene except its mesh and effects, as in `springbench.harness.scenes.scene_spec.SceneFields`.

    Example:
        >>> keys: springbench.SceneKeys = {"mass": 1.0, "time_step": 1 / 30, "frames": 30, "default_size": 5}
        >>> springbench.make_scene(mesh={"kind": "chain"}, **keys).frames
        30
    """

    description: str
    mass: float | None
    mass_per_area: float | None
    fabric: str | Mapping[str, Any] | None
    time_step: Required[NumberOrText]
    alternate_time_step: NumberOrText | None
    frames: Required[int]
    velocity: Sequence[float]
    start: Mapping[str, Any] | None
    default_size: int | None
    camera: Mapping[str, float] | None


class OptionKeys(TypedDict, total=False):
    """Options of a sweep, as in `springbench.harness.config.sweep_config.SweepOptions`.

    Example:
        >>> options: springbench.OptionKeys = {"max_iterations": [10, 20], "frames": 2}
        >>> sorted(options)
        ['frames', 'max_iterations']
    """

    max_iterations: OneOrSequence[int]
    rtol: OneOrSequence[float | Literal["auto"] | None]
    integrator: OneOrSequence[IntegratorName | UserCodeName]
    time_step: OneOrSequence[NumberOrText | None]
    initial_guess: OneOrSequence[InitialGuess | None]
    threads: OneOrSequence[int | Literal["auto"]]
    frames: OneOrSequence[int | None]
    rounds: OneOrSequence[int]
    error_target: OneOrSequence[float | None]
    convergence_frames: Sequence[int] | None
    strain_range: float | None
    record: bool
    pictures: bool
    verify: bool
    timing: Literal["exclusive", "shared", "none"]
    time_limit: float | None
    memory_limit: float | None


class SweepKeys(TypedDict, total=False):
    """Keys of a sweep, as in `springbench.harness.config.sweep_config.SweepConfig`.

    A solver with parameters is a mapping.

    Example:
        >>> sweep: springbench.SweepKeys = {"scenes": ["chain.yaml"], "sizes": [5], "solvers": ["sparse", "newton"]}
        >>> sorted(sweep)
        ['scenes', 'sizes', 'solvers']
    """

    description: str
    scenes: Required[Sequence[str]]
    sizes: Sequence[int]
    solvers: Required[Sequence[SolverName | UserCodeName | Mapping[str, Any]]]
    options: OptionKeys
    exclude: Sequence[Mapping[str, Any]]
    include: Sequence[Mapping[str, Any]]
    reports: Sequence[ReportName | UserCodeName]
