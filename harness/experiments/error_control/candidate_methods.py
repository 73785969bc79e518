"""Methods for error-controlled runs: adaptive solvers, and integrators combined with solvers of their steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from springbench.harness.config.config_loader import find_scene_mistakes
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.execution.progress_display import ThrottledMessages
from springbench.harness.reference.self_converged_trajectory import LIMIT_INTEGRATORS, has_contact
from springbench.harness.reference.step_snapshot import build_exact_scene
from springbench.harness.results.solver_metadata import read_registered_traits
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.adaptive_stepping import AdaptiveImplicitStepper, Stepper
from springbench.harness.simulation.fixed_stepping import FixedImplicitStepper
from springbench.harness.simulation.substepping import AdaptiveSubstepper, FixedSubstepper
from springbench.solvers.model.integrators import INTEGRATORS, RungeKutta, SingleStageIntegrator, find_integrator
from springbench.solvers.model.step_problem import NotPositiveDefinite, Unsupported
from springbench.solvers.registry import SOLVER_TABLE, SOLVERS, find_solver_info, is_minimiser, load_target

_WARMUP_TOLERANCE = 1e-2
"""Tolerance of the warm-up run, which only compiles, as a fraction of the mesh size."""


@dataclass(frozen=True, slots=True)
class ErrorTarget:
    """Scene of one size up to an end time, split into frames.

    Dirichlet conditions are exact, as in the reference.

    Attributes:
        scene: the scene.
        size: size of the mesh.
        t_end: simulated time [s].
        num_frames: number of frames of equal length up to t_end.
    """

    scene: SceneSpec
    size: int
    t_end: float
    num_frames: int

    @classmethod
    def from_scene(
        cls,
        scene: SceneSpec,
        size: int | None,
        t_end: float | None,
    ) -> ErrorTarget:
        """Return the target for a scene.

        A frame is about as long as the scene's time step.

        Args:
            scene: the scene.
            size: size of the mesh; the scene's default if None.
            t_end: simulated time [s]; that of the scene if None.

        Raises:
            InputError: the size or the time step does not fit the scene.
        """
        scene.require_fixed_time_step()
        t_end = t_end or scene.frames * scene.time_step
        size = size or scene.default_size or 0
        frames = max(1, round(t_end / scene.time_step))
        if mistakes := find_scene_mistakes(scene, [size]):
            raise InputError(mistakes)
        return cls(scene, size, t_end, frames)

    def build_scene(self, time_step: float, integrator: str) -> Scene:
        """Build the scene with exact pins.

        Args:
            time_step: time step [s].
            integrator: name of the integrator.
        """
        return build_exact_scene(self.scene.with_time_step(time_step), self.size, integrator, show_warnings=False)

    @property
    def has_contact(self) -> bool:
        """Whether the scene has contact."""
        return has_contact(self.build_scene(self.frame_seconds, "implicit-euler").system)

    @property
    def frame_seconds(self) -> float:
        """Length of a frame [s]."""
        return self.t_end / self.num_frames


@dataclass(frozen=True, slots=True)
class Method:
    """Integrator and solver by name, and the stepper that combines them."""

    integrator: str
    solver: str
    stepper: Stepper

    def __str__(self) -> str:
        return format_method_name(self.integrator, self.solver)


def format_method_name(integrator: str, solver: str) -> str:
    """Return the name of a method for messages.

    Args:
        integrator: name of the integrator; `substepping` is that of the solver itself, and is omitted.
        solver: name of the solver.
    """
    return solver if integrator == "substepping" else f"{integrator} with {solver}"


def list_candidate_methods() -> list[tuple[str, SolverSpec]]:
    """Return the integrators (by name) and solvers that a search tries by default.

    Solvers with their own adaptive integrator come first. The others are solvers that minimise the step's objective.
    They are combined with the embedded Runge-Kutta integrator of the highest order, and among equals of the highest
    stage order. They are also combined with the one-step integrator of fixed step size that has the highest order.
    """
    pairs = {name: one for name, one in INTEGRATORS.items() if isinstance(one, RungeKutta) and one.embedded_order}
    best = max(pairs, key=lambda name: (pairs[name].order, pairs[name].stage_order))
    traits = read_registered_traits()
    single = {
        name: one.order
        for name, one in INTEGRATORS.items()
        if isinstance(one, SingleStageIntegrator) and not one.needs_history
    }
    even = max((name for name in single if name != "substepping"), key=single.__getitem__)
    tried = {
        name: ("substepping",) if traits[name].is_substepping else (best, even)
        for name in SOLVERS
        if traits[name].supports_error_control
    }
    found = [(integrator, SolverSpec(name, {})) for name, several in tried.items() for integrator in several]
    return sorted(found, key=lambda pair: pair[0] != "substepping")


def list_contact_methods() -> list[tuple[str, SolverSpec]]:
    """Return the integrators that support contact, combined with the first minimising solver of each family."""
    traits = read_registered_traits()
    first = [name for name in SOLVERS if traits[name].is_minimiser and traits[name].is_family_default]
    return [(integrator, SolverSpec(name, {})) for name in first for integrator in LIMIT_INTEGRATORS]


def list_methods_of_solver(solver: SolverSpec) -> list[tuple[str, SolverSpec]]:
    """Return all methods of one solver: its own integrator, or all embedded Runge-Kutta integrators.

    Raises:
        Unsupported: the solver has no error estimate and does not minimise the steps of an integrator.
    """
    one = find_solver_info(load_target(SOLVER_TABLE[solver.name]), solver.name)
    if one.is_substepping:
        return [("substepping", solver)]
    if not is_minimiser(load_target(SOLVER_TABLE[solver.name])):
        raise Unsupported(f"{solver.name}: has no error estimate and does not minimise the objective of an integrator")
    return [(name, solver) for name, one in INTEGRATORS.items() if isinstance(one, RungeKutta) and one.embedded_order]


def list_contact_methods_of_solver(solver: SolverSpec) -> list[tuple[str, SolverSpec]]:
    """Return the integrators that support contact, combined with one solver.

    Raises:
        Unsupported: the solver does not minimise the steps of an integrator.
    """
    if not is_minimiser(load_target(SOLVER_TABLE[solver.name])):
        raise Unsupported(f"{solver.name}: does not minimise an objective, which error control with contact requires")
    return [(name, solver) for name in LIMIT_INTEGRATORS]


def prepare_candidate_methods(
    error_target: ErrorTarget, print_message: Callable[[str], None], candidates: Sequence[tuple[str, SolverSpec]] = ()
) -> list[Method]:
    """Return the methods that support the scene, warmed up so that timings exclude compilation.

    Args:
        error_target: the scene and its end time.
        print_message: prints progress, and the methods that do not support the scene, with the reason.
        candidates: integrators and solvers; `list_candidate_methods` if empty.

    Raises:
        RunFailed: no method supports the scene.
    """
    found, reasons = list[Method](), list[str]()
    pairs, remark = list(candidates or list_candidate_methods()), ThrottledMessages(print_message)
    for number, (integrator, solver) in enumerate(pairs):
        remark(f"  {number} of {len(pairs)} methods are prepared")
        method = Method(integrator, solver.name, _build_stepper(error_target, integrator, solver))
        try:
            _warm_up(error_target, integrator, solver)
            found.append(method)
        except (Unsupported, NotPositiveDefinite) as error:
            reasons.append(f"{method}: {str(error).removeprefix(f'{solver.name}: ')}")
            print_message(f"  unsupported: {reasons[-1]}")
    if not found:
        raise RunFailed(f"no method with error control supports this scene: {'; '.join(reasons)}")
    return found


def _build_stepper(
    error_target: ErrorTarget, integrator: str, solver: SolverSpec, frames: int | None = None
) -> Stepper:
    made, frames = load_target(SOLVER_TABLE[solver.name])(**solver.parameters), frames or error_target.num_frames
    if integrator == "substepping":
        scene, even = (
            error_target.build_scene(error_target.frame_seconds, integrator),
            find_solver_info(load_target(SOLVER_TABLE[solver.name]), solver.name).has_fixed_step,
        )
        return (
            FixedSubstepper(scene, made, frames, lambda h: error_target.build_scene(h, integrator))
            if even
            else AdaptiveSubstepper(scene, made, frames)
        )
    stepper_class = (
        AdaptiveImplicitStepper if isinstance(find_integrator(integrator), RungeKutta) else FixedImplicitStepper
    )
    build_scene = partial(error_target.build_scene, integrator=integrator)
    return stepper_class(build_scene, made, error_target.frame_seconds * frames, frames)


def _warm_up(error_target: ErrorTarget, integrator: str, solver: SolverSpec) -> None:
    size = error_target.build_scene(error_target.frame_seconds, "substepping").mesh.bounding_box_diagonal or 1.0
    once = _build_stepper(error_target, integrator, solver, 1)
    once.integrate_motion(once.initial_setting(_WARMUP_TOLERANCE * size))
