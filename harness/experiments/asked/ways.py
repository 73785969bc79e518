"""Ways to follow a motion to an error: solvers with steps of their own, and integrators with solvers of their steps."""

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
"""Of the mesh's size: the tolerance of what only compiles."""
_SPENT = 30.0
"""Seconds on what can be had instead of a promise."""
_CONTACT = (
    "contact begins and ends within steps, where every method here has order 1: no error can be promised; run it with "
    "steps of one length (--integrator, --time-step), and halve them until the motion stays as it is"
)


@dataclass(frozen=True, slots=True)
class Asked:
    """A scene of one size, up to a horizon [s] that is so many frames. Pins are exact, as in the reference."""

    scene: SceneSpec
    size: int
    horizon: float
    frames: int

    @classmethod
    def of(
        cls, scene: SceneSpec, size: int | None, horizon: float | None, say: Callable[[str], None] | None = None
    ) -> Asked:
        """Of the scene's own size and length where none are given; frames are about as long as its time step.

        Raises InputError, and RunFailed for contact."""
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
        """The scene with steps of a length [s] and an integrator by name."""
        return bind(self.scene.stepped(time_step), self.size, integrator, warns=False)

    @property
    def frame(self) -> float:
        """The length of a frame [s]."""
        return self.horizon / self.frames


@dataclass(frozen=True, slots=True)
class Way:
    """An integrator and a solver by name, and how they follow the motion."""

    integrator: str
    solver: str
    follower: Follower

    def __str__(self) -> str:
        return in_words(self.integrator, self.solver)


def in_words(integrator: str, solver: str) -> str:
    """What a way is called, by the names of both."""
    return solver if integrator == "own" else f"{integrator} with {solver}"


def tried() -> list[tuple[str, SolverSpec]]:
    """Integrators and solvers by name: those with steps of their own, and those that minimise what the integrator
    with an error states that has the highest order, and the highest of its stages; and, with steps of one length, what
    the one states that has the highest order of those of one unknown that begin anew each step."""
    pairs = {name: one for name, one in INTEGRATORS.items() if isinstance(one, RungeKutta) and one.embedded}
    best = max(pairs, key=lambda name: (pairs[name].order, pairs[name].starts))
    told = {name: about(load(target), name) for name, target in SOLVERS.items()}
    single = {name: one.order for name, one in INTEGRATORS.items() if isinstance(one, Integrator) and not one.history}
    even = max((name for name in single if name != "own"), key=single.__getitem__)
    tried = {name: ("own",) if one.own_steps else (best, even) for name, one in told.items() if one.to_error}
    found = [(integrator, SolverSpec(name, {})) for name, several in tried.items() for integrator in several]
    return sorted(found, key=lambda pair: pair[0] != "own")


def tried_by(solver: SolverSpec) -> list[tuple[str, SolverSpec]]:
    """What one solver can do of that, with all integrators that tell an error. Raises Unsupported for nothing."""
    one = about(load(EVERY[solver.name]), solver.name)
    if one.own_steps:
        return [("own", solver)]
    if not minimises(load(EVERY[solver.name])):
        raise Unsupported(f"{solver.name}: tells no error of its steps and does not minimise those of an integrator")
    return [(name, solver) for name, one in INTEGRATORS.items() if isinstance(one, RungeKutta) and one.embedded]


def ways(asked: Asked, say: Callable[[str], None], pairs: Sequence[tuple[str, SolverSpec]] = ()) -> list[Way]:
    """Those that know the scene, warmed up: what they compile counts against nobody; others are told, with the reason.
    pairs: of integrators and solvers, all that are tried if left out. Raises RunFailed for none."""
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
