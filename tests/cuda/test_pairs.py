"""Contact by pairs on a device: vertex block descent's iterates are the processor's, and nothing passes through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from harness.scenes.bind import Scene
from harness.scenes.effects.base import Effect
from harness.scenes.effects.contact import Contact
from harness.scenes.effects.gravity import Gravity
from harness.scenes.effects.pins import Pins
from harness.scenes.effects.self_contact import SelfContact
from harness.scenes.effects.springs import Springs
from harness.scenes.effects.surface_contact import SurfaceContact
from harness.scenes.mesh.grid import Grid
from harness.scenes.mesh.stack import Stack
from harness.scenes.motion import Key, KeyedMotion
from harness.scenes.obstacles import Box
from harness.simulation.clock import Clock, Watch
from harness.simulation.measure import Settings, steps
from harness.simulation.on_device import Replayed, on_device
from harness.simulation.step import State, prepare, problem, start
from solvers.contact import pairs_vbd
from solvers.contact.barrier import distances
from solvers.contact.contacts import Pairs
from solvers.contact.self_contact import PairContact
from solvers.contact.ways import LEFT
from solvers.cuda.candidates import Search
from solvers.cuda.run import Stream
from solvers.cuda.vbd_pairs import Guarded
from solvers.methods.vbd import VertexBlockDescent
from solvers.problem import StepProblem, StopRule, Unsupported
from tests.contacts import contact
from tests.cuda.near import iterates, same_iterates
from tests.cuda.test_steps import staying
from tests.scenes import scene

THICKNESS, ITERATIONS = 0.02, 2
APART = SelfContact(thickness=THICKNESS, range=0.03, friction=0.4)
RISES = KeyedMotion(keys=(Key(time=0.0), Key(time=1.0, offset=(0.0, 0.1, 0.0))))


def sheets(*effects: Effect, size: int = 2, apart: float = 0.1) -> Scene:
    """Two free sheets, one above the other."""
    return scene(Stack(apart=apart), Springs(stretch=300.0, shear=60.0), Gravity(), *effects, size=size)


def on_corner(motion: KeyedMotion | None = None, size: int = 2) -> Scene:
    """A sheet above a corner of a box, held at two of its own."""
    box = Box(low=(-0.1, -0.5, -0.2), high=(0.7, -0.1, 0.1), motion=motion)
    touched = SurfaceContact(thickness=THICKNESS, range=0.03, friction=0.4, obstacles=(box,))
    return scene(Grid(), Springs(stretch=300.0, shear=60.0), Gravity(), Pins(at=("top_corners",)), touched, size=size)


def falls(made: Scene, drop: float, speed: float = 1.0) -> StepProblem:
    """A step in which what is above, lower by `drop` [m], comes down at a speed [m/s], its start a little disturbed."""
    state, rng = start(made), np.random.default_rng(0)
    p, v = state.now.positions.copy(), state.now.velocity.copy()
    above = p[:, 1] > p[:, 1].mean() - 1e-9
    p[above, 1] -= drop
    p += 0.002 * rng.normal(size=p.shape)
    v[above] -= [0.2, speed, 0.1]
    return problem(made, State(state.now._replace(positions=p, velocity=v), None, 0), "current")


def pressed(made: StepProblem) -> StepProblem:
    """The step with friction's normal forces where the processor is after some iterations."""
    x = iterates(VertexBlockDescent(), made, ITERATIONS)[-1].copy()
    return replace(made, first_guess=x, start=replace(made.start, pressed=x))


PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "a further round of friction": lambda: pressed(falls(sheets(APART), 0.066)),
    "a further round of friction on a box that rises": lambda: pressed(falls(on_corner(RISES), 0.06)),
    "sheets in range": lambda: falls(sheets(APART), 0.066),
    "sheets that arrive from out of range": lambda: falls(sheets(APART), 0.0, 4.0),
    "a box that rises": lambda: falls(on_corner(RISES), 0.06),
}


def near(found: StepProblem) -> int:
    """How many contacts there are where the processor is after the iterations."""
    end = iterates(VertexBlockDescent(), found, ITERATIONS)[-1]
    return sum(len(e.blocks(end).vertices) for e in found.energies if isinstance(e, PairContact))


@pytest.mark.parametrize("name", PROBLEMS)
def test_iterates_with_pairs_are_those_of_the_processor(name: str) -> None:
    found = PROBLEMS[name]()
    assert near(found) > 0
    same_iterates(VertexBlockDescent, found, ITERATIONS)


def test_pairs_are_those_that_the_processor_finds() -> None:
    """On a way at least those that leave less than they have to: boxes are told by cells."""
    found = PROBLEMS["sheets in range"]()
    (surface,) = (energy.surface for energy in found.energies if isinstance(energy, PairContact))
    p, stream, n = found.start.positions, Stream(), found.system.vertices
    q = p + 0.1 * np.random.default_rng(1).normal(size=p.shape)
    search, begin, end = Search("vbd", stream, surface, np.arange(n), n), stream.upload(p), stream.upload(q)

    def told(pairs: Pairs) -> set[tuple[int, ...]]:
        return set(map(tuple, np.asarray(pairs.vertices).tolist()))

    reach = surface.thickness + surface.reach
    wanted = told(surface.within(p, reach))
    assert wanted
    assert told(search.within(begin, reach).pairs) == wanted
    every = surface.within(p, 1e3)
    least = np.min([distances(every, p + t * (q - p)) for t in np.linspace(0.0, 1.0, 9)], axis=0)
    bound = every.vertices[least < LEFT * distances(every, p)]
    assert 0 < len(bound) < len(every.vertices)
    assert told(every._replace(vertices=bound)) <= told(search.on_way(begin, end, 0.0, LEFT).pairs)


def every_other_search_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that rows go by their own blocks."""
    for owner, name, nothing in ((pairs_vbd, "search", None), (Guarded, "_search", False)):
        monkeypatch.setattr(owner, name, _every_other(getattr(owner, name), nothing))


def _every_other(usual: Any, nothing: Any) -> Any:
    asked = list[int]()

    def search(*given: Any) -> Any:
        asked.append(0)
        return usual(*given) if len(asked) % 2 == 0 else nothing

    return search


def test_where_a_sweep_does_not_descend_rows_go_by_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    every_other_search_fails(monkeypatch)
    same_iterates(VertexBlockDescent, PROBLEMS["sheets in range"](), 2)


def test_steps_with_pairs_stay_there_and_are_the_processors() -> None:
    made, settings = (
        sheets(APART.model_copy(update={"friction_rounds": 1}), apart=0.04),
        Settings(StopRule(2), "inertial", 2, 1),
    )
    on_it, there = staying(made, VertexBlockDescent(device="cuda", precision="float64"), "inertial"), list[Any]()
    for step in steps(made, on_it, settings):
        on_it.keep(step)
        there.append(step.positions)
    here = [step.positions for step in steps(made, prepare(made, VertexBlockDescent()), settings)]
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-10)
    on_it.upload()
    assert len(list(on_it.timed(Clock(Watch())))) == 2
    np.testing.assert_array_equal(on_it.download(), there[-1])


def test_a_host_makes_way_for_surfaces_that_move() -> None:
    made = on_corner(RISES)
    found = on_device(made, prepare(made, VertexBlockDescent(device="cuda")), "current")
    assert isinstance(found, Replayed)
    assert "makes way" in str(found.through_host)


def test_contact_of_vertices_beside_surfaces_is_refused() -> None:
    made = sheets(APART, Contact.model_validate(contact({"kind": "plane", "point": (0, -1, 0)})))
    with pytest.raises(Unsupported, match="state surface-contact"):
        VertexBlockDescent(device="cuda").prepare(made.system)
