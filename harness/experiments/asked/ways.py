"""Methods for error-controlled runs: adaptive solvers, and integrators combined with solvers of their steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from harness.base.errors import InputError, RunFailed
from harness.config.load import misfits
from harness.config.sweep import SolverSpec
from harness.experiments.asked.halving import halved
from harness.reference.frozen import bind
from harness.scenes.bind import Scene
from harness.scenes.spec import SceneSpec
from harness.simulation.controlled import Follower, Implicit
from harness.simulation.even_steps import ImplicitEven
from harness.simulation.own_steps import Own, OwnEven
from solvers.contact.touching import without_contact
from solvers.integrators import INTEGRATORS, Integrator, RungeKutta, find
from solvers.problem import NotPositiveDefinite, Unsupported
from solvers.registry import EVERY, SOLVERS, about, load, minimises

_ONCE = 1e-2
"""Tolerance of the warm-up run, which only compiles, as a fraction of the mesh size."""
_SPENT = 30.0
"""Wall time for the step-doubling estimate where error control is not possible [s]."""
_CONTACT = (
    "contact begins and ends within steps, where every method has order 1, so errors cannot be controlled; use a fixed "
    "step size (--integrator, --time-step), and halve it until the motion does not change"
)


@dataclass(frozen=True, slots=True)
class Asked:
    """Scene of one size up to an end time, split into frames.

    Dirichlet conditions are exact, as in the reference.

    Attributes:
        scene: the scene.
        size: size of the mesh.
        horizon: simulated time [s].
        frames: number of frames of equal length up to horizon.
    """

    scene: SceneSpec
    size: int
    horizon: float
    frames: int

    @classmethod
    def of(
        cls, scene: SceneSpec, size: int | None, horizon: float | None, say: Callable[[str], None] | None = None
    ) -> Asked:
        """Return the target for a scene.

        A frame is about as long as the scene's time step.

        Args:
            scene: the scene.
            size: size of the mesh; the scene's default if None.
            horizon: simulated time [s]; that of the scene if None.
            say: prints a remark.

        Raises:
            InputError: the size or the time step does not fit the scene.
            RunFailed: the scene has contact.
        """
        scene.require_even_steps()
        horizon = horizon or scene.frames * scene.time_step
        size = size or scene.default_size or 0
        frames = max(1, round(horizon / scene.time_step))
        if mistakes := misfits(scene, [size]):
            raise InputError(mistakes)
        asked = cls(scene, size, horizon, frames)
        system = asked.bound(asked.frame, "implicit-euler").system
        if without_contact(system) is not system:
            if say:
                say(f"no error can be promised with contact; halving steps for {_SPENT:g} s to tell what can be had")
            raise RunFailed(f"{_CONTACT}; {halved(asked.bound, horizon, frames, seconds=_SPENT)}")
        return asked

    def bound(self, time_step: float, integrator: str) -> Scene:
        """Build the scene with a time step [s] and an integrator by name."""
        return bind(self.scene.stepped(time_step), self.size, integrator, warns=False)

    @property
    def frame(self) -> float:
        """Length of a frame [s]."""
        return self.horizon / self.frames


@dataclass(frozen=True, slots=True)
class Way:
    """Integrator and solver by name, and the stepper that combines them."""

    integrator: str
    solver: str
    follower: Follower

    def __str__(self) -> str:
        return in_words(self.integrator, self.solver)


def in_words(integrator: str, solver: str) -> str:
    """Return the name of a method for messages."""
    return solver if integrator == "own" else f"{integrator} with {solver}"


def tried() -> list[tuple[str, SolverSpec]]:
    """Return the integrators (by name) and solvers that a search tries by default.

    Solvers with their own adaptive integrator come first. The others are solvers that minimise the step's objective.
    They are combined with the embedded Runge-Kutta integrator of the highest order, and among equals of the highest
    stage order. They are also combined with the one-step integrator of fixed step size that has the highest order.
    """
    pairs = {name: one for name, one in INTEGRATORS.items() if isinstance(one, RungeKutta) and one.embedded}
    best = max(pairs, key=lambda name: (pairs[name].order, pairs[name].starts))
    told = {name: about(load(target), name) for name, target in SOLVERS.items()}
    single = {name: one.order for name, one in INTEGRATORS.items() if isinstance(one, Integrator) and not one.history}
    even = max((name for name in single if name != "own"), key=single.__getitem__)
    tried = {name: ("own",) if one.own_steps else (best, even) for name, one in told.items() if one.to_error}
    found = [(integrator, SolverSpec(name, {})) for name, several in tried.items() for integrator in several]
    return sorted(found, key=lambda pair: pair[0] != "own")


def tried_by(solver: SolverSpec) -> list[tuple[str, SolverSpec]]:
    """Return all methods of one solver: its own integrator, or all embedded Runge-Kutta integrators.

    Raises:
        Unsupported: the solver has no error estimate and does not minimise the steps of an integrator.
    """
    one = about(load(EVERY[solver.name]), solver.name)
    if one.own_steps:
        return [("own", solver)]
    if not minimises(load(EVERY[solver.name])):
        raise Unsupported(f"{solver.name}: tells no error of its steps and does not minimise those of an integrator")
    return [(name, solver) for name, one in INTEGRATORS.items() if isinstance(one, RungeKutta) and one.embedded]


def ways(asked: Asked, say: Callable[[str], None], pairs: Sequence[tuple[str, SolverSpec]] = ()) -> list[Way]:
    """Return the methods that support the scene, warmed up so that timings exclude compilation.

    Args:
        asked: the scene and its end time.
        say: prints the methods that do not support the scene, with the reason.
        pairs: integrators and solvers; `tried` if empty.

    Raises:
        RunFailed: no method supports the scene.
    """
    found, reasons = list[Way](), list[str]()
    for integrator, solver in pairs or tried():
        way = Way(integrator, solver.name, _follower(asked, integrator, solver))
        try:
            _warm(asked, integrator, solver)
            found.append(way)
        except (Unsupported, NotPositiveDefinite) as error:
            reasons.append(f"{way}: {str(error).removeprefix(f'{solver.name}: ')}")
            say(f"  not by {reasons[-1]}")
    if not found:
        raise RunFailed(f"no method that keeps to an error knows this scene: {'; '.join(reasons)}")
    return found


def _follower(asked: Asked, integrator: str, solver: SolverSpec, frames: int | None = None) -> Follower:
    made, frames = load(EVERY[solver.name])(**solver.parameters), frames or asked.frames
    if integrator == "own":
        scene, even = asked.bound(asked.frame, integrator), about(load(EVERY[solver.name]), solver.name).even
        return OwnEven(scene, made, frames, lambda h: asked.bound(h, integrator)) if even else Own(scene, made, frames)
    way = Implicit if isinstance(find(integrator), RungeKutta) else ImplicitEven
    return way(lambda h: asked.bound(h, integrator), made, asked.frame * frames, frames)


def _warm(asked: Asked, integrator: str, solver: SolverSpec) -> None:
    size = asked.bound(asked.frame, "own").mesh.size or 1.0
    once = _follower(asked, integrator, solver, 1)
    once.follow(once.first(_ONCE * size))
