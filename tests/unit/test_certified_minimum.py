"""Reference minima: certified, distinguished where there are several, and stored."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.reference.certified_minimum import (
    INACCURATE,
    SADDLE,
    VALLEY,
    KnownMinima,
    UncertifiedError,
    build_free_hessian,
    certify_minimum,
    find_minima,
    refine_minimum,
)
from springbench.harness.reference.hessian_curvature import compute_curvature
from springbench.harness.reference.reference_store import ReferenceStore
from springbench.harness.reference.step_snapshot import StepSnapshot
from springbench.harness.reference.step_verifier import is_minimum
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import DirichletPins, Positions, Solution, StepProblem, StopRule, System

from tests.scene_builders import build_cloth, build_first_problem, build_random_problem, build_step_start

PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "cloth": lambda: build_first_problem(build_cloth(6, "exact")),
    "random, compressed and stretched": lambda: build_random_problem(2, weights=(np.inf, np.inf)),
    "random, pinned by penalty too": lambda: build_random_problem(3),
    "random, not pinned": lambda: build_random_problem(4, weights=()),
}
problems = pytest.mark.parametrize("problem", [make() for make in PROBLEMS.values()], ids=list(PROBLEMS))


@dataclass(frozen=True)
class Stays:
    """A solver that ends where it begins."""

    is_minimiser: ClassVar[bool] = True
    is_monotone: ClassVar[bool] = True
    description: ClassVar[str] = ""
    stats: ClassVar[dict[str, float]] = {}

    def prepare(self, system: System) -> Any:
        return self

    def iterates(self, problem: StepProblem) -> Iterator[Positions]:
        yield problem.initial_guess

    def solve(self, problem: StepProblem, stop: StopRule) -> Solution:
        return Solution(problem.initial_guess.copy(), 1, 0.0, 0.0, "converged")

    def residual_at(self, problem: StepProblem, p: Positions) -> float:
        return 0.0

    def iteration_phases(self, problem: StepProblem) -> dict:
        return {}


def snap_through(weight: float = 0.005, height: float = 0.2) -> StepProblem:
    """A mass on four struts that are too long for their pins, stable above these and below them; its weight [N] makes
    the lower place the better one, for inertia is weak. It starts at a height [m] over the pins."""
    rest = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.2, 0.0]])
    springs = Springs.from_rest_shape(rest, np.array([[0, 4], [1, 4], [2, 4], [3, 4]]), np.full(4, 100.0))
    system = System(np.full(5, 1e-4), 0.1, (springs,), DirichletPins(np.arange(4), np.full(4, np.inf)))
    force, current = np.zeros((5, 3)), rest.copy()
    force[4, 1], current[4, 1] = -weight, height
    return StepProblem(system, current, force, rest[:4], current, current, build_step_start(system, current, current))


FLAT = snap_through(weight=0.0, height=0.0)
"""Between its pins and without weight the mass is in balance, and about to snap."""


def build_snapshot(problem: StepProblem) -> StepSnapshot:
    return StepSnapshot(1, problem, Motion(problem.current_positions, problem.step_start.velocity), "0123456789ab")


def lower(p: Positions) -> Positions:
    """The mirror image below the pins."""
    return p * np.array([1.0, -1.0, 1.0])


@problems
def test_the_hessian_is_the_derivative_of_the_gradient(problem):
    p, free, h = problem.initial_guess, problem.system.free_vertices, 1e-6
    H = build_free_hessian(problem, p).toarray()
    for column, (vertex, axis) in enumerate((v, a) for v in free for a in range(3)):
        e = np.zeros_like(p)
        e[vertex, axis] = h
        difference = (problem.gradient(p + e) - problem.gradient(p - e))[free].ravel() / (2 * h)
        # Central differences: h^2 of the third derivative, and round-off of the gradient over h.
        np.testing.assert_allclose(H[:, column], difference, rtol=0, atol=1e-7 * np.abs(H).max())


@problems
def test_a_minimum_is_certified_by_the_reference_evaluator(problem):
    for found in find_minima(problem, NewtonSolver()).minima:
        assert found.is_certified
        assert found.objective == problem.value(found.positions)
        values = np.linalg.eigvalsh(build_free_hessian(problem, found.positions).toarray())
        assert values[0] > 0.0
        assert found.min_eigenvalue == pytest.approx(values[0], rel=1e-3)  # as the inverse iteration requires
        # What round-off leaves of the gradient moves the softest vertex by the error.
        gradient = np.abs(problem.gradient(found.positions)).max()
        assert gradient <= 10 * values[-1] * np.finfo(float).eps * np.abs(found.positions).max()
        assert found.newton_step_length <= 1e-12
        assert not found.positions.flags.writeable
        exact = problem.system.pins.exact_mask
        pinned = problem.system.pins.vertices[exact]
        np.testing.assert_array_equal(found.positions[pinned], problem.pin_targets[exact])


@problems
def test_no_neighbour_of_a_minimum_is_lower(problem):
    rng, best = np.random.default_rng(0), find_minima(problem, NewtonSolver()).lowest_minimum
    for size in (1e-3, 1e-2):
        for _ in range(20):
            e = np.zeros_like(best.positions)
            e[problem.system.free_vertices] = size * rng.normal(size=(len(problem.system.free_vertices), 3))
            assert problem.value(best.positions + e) > best.objective


@problems
def test_newton_steps_continue_to_round_off_from_any_solution(problem):
    best = find_minima(problem, NewtonSolver()).lowest_minimum
    for size in (1e-5, 1e-8):
        start = best.positions + size * np.random.default_rng(1).normal(size=best.positions.shape)
        found = certify_minimum(problem, start)
        assert found.is_certified
        # Two ends of the same descent; both know the minimum to round-off times the condition of a few thousand.
        np.testing.assert_allclose(found.positions, best.positions, rtol=0, atol=1e-11)


def test_a_saddle_is_not_certified():
    assert not FLAT.gradient(FLAT.current_positions).any()
    found = certify_minimum(FLAT, FLAT.current_positions)
    assert not found.is_certified
    assert found.kind == SADDLE
    assert found.min_eigenvalue < -found.eigenvalue_uncertainty


def test_the_search_for_a_minimum_leaves_a_saddle():
    found = refine_minimum(FLAT, FLAT.current_positions, NewtonSolver())
    assert found.is_certified
    assert abs(found.positions[4, 1]) > 0.1


def test_a_point_that_is_no_minimum_is_never_a_reference(tmp_path):
    reference = ReferenceStore(tmp_path, Stays()).find_minima(build_snapshot(FLAT))
    assert reference.minima == ()
    with pytest.raises(UncertifiedError, match="it is a saddle"):
        _ = reference.lowest_minimum
    assert not list(tmp_path.iterdir())


def test_a_lower_minimum_replaces_the_reference(tmp_path):
    problem, store = snap_through(), ReferenceStore(tmp_path)
    one = build_snapshot(problem)
    above = store.find_minima(one).lowest_minimum
    assert above.positions[4, 1] > 0.1
    below = store.classify_minimum(one, lower(above.positions))
    assert below.positions[4, 1] < -0.1
    assert below.objective < above.objective
    again = ReferenceStore(tmp_path).find_minima(one)
    assert [m.objective for m in again.minima] == [below.objective, above.objective]
    assert [again.find_index(m) for m in (below, above)] == [0, 1]
    assert again.lowest_minimum.minimum_id == below.minimum_id != above.minimum_id


def test_a_point_belongs_to_the_minimum_that_newtons_method_finds_from_it(tmp_path):
    problem, store = snap_through(), ReferenceStore(tmp_path)
    one = build_snapshot(problem)
    above = store.find_minima(one).lowest_minimum
    rng, names = np.random.default_rng(0), {}
    for side, start in (("above", above.positions), ("below", lower(above.positions))):
        points = [start + 0.02 * rng.normal(size=(5, 3)) for _ in range(4)]
        names[side] = {store.classify_minimum(one, p).minimum_id for p in points}
    assert names["above"] == {above.minimum_id}  # one name each, whatever was found in between
    assert len(names["below"]) == 1
    assert len(store.find_minima(one).minima) == 2


def test_a_point_that_leads_to_no_minimum_has_no_branch(tmp_path):
    known = ReferenceStore(tmp_path).find_minima(build_snapshot(FLAT))
    found = ReferenceStore(tmp_path, Stays()).classify_minimum(build_snapshot(FLAT), FLAT.current_positions)
    assert not found.is_certified
    assert len(ReferenceStore(tmp_path).find_minima(build_snapshot(FLAT)).minima) == len(known.minima)


def test_minima_are_found_once(tmp_path):
    one = build_snapshot(PROBLEMS["cloth"]())
    found = ReferenceStore(tmp_path).find_minima(one).lowest_minimum
    again = ReferenceStore(tmp_path, Stays()).find_minima(one).lowest_minimum
    np.testing.assert_array_equal(found.positions, again.positions)
    fields = ("objective", "newton_step_length", "min_eigenvalue", "eigenvalue_uncertainty", "kind", "minimum_id")
    assert [getattr(found, f) for f in fields] == [getattr(again, f) for f in fields]
    assert not again.positions.flags.writeable


def test_minima_are_identified_by_their_positions():
    problem = snap_through()
    above = find_minima(problem, NewtonSolver()).lowest_minimum
    below = refine_minimum(problem, lower(above.positions), NewtonSolver())
    nudged = replace(above, positions=above.positions + 1e-12)
    known = KnownMinima(()).add_minimum(above).add_minimum(nudged).add_minimum(below)
    assert [m.objective for m in known.minima] == [below.objective, above.objective]
    assert known.find_index(nudged) == 1
    uncertified = replace(above, positions=above.positions + 0.5, objective=-1e9, kind=SADDLE)
    assert known.add_minimum(uncertified) is known


STANDING = Path(__file__).resolve().parents[2] / "configs" / "hard" / "saddle-standing-chain.yaml"
"""A chain on its first vertex, which may buckle to any side: the minima of a step are a circle."""


def standing(folder: Path) -> tuple[ReferenceStore, StepSnapshot]:
    store = ReferenceStore(folder)
    return store, store.load_frames(load_scene(STANDING), 9, [1])[1]


def rotate_about_pin(problem: StepProblem, p: Positions, angle: float) -> Positions:
    """p turned about the vertical line through the pinned vertex."""
    c, s, foot = np.cos(angle), np.sin(angle), p[problem.system.pins.vertices[0]]
    return foot + (p - foot) @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])


def test_a_valley_of_minima_is_found_as_such_and_is_no_reference(tmp_path):
    store, one = standing(tmp_path)
    found = refine_minimum(one.problem, one.problem.current_positions, NewtonSolver())
    assert found.kind == VALLEY
    assert abs(found.min_eigenvalue) <= found.eigenvalue_uncertainty < 1e-9
    other = rotate_about_pin(one.problem, found.positions, 1.0)
    assert np.linalg.norm(other - found.positions, axis=1).max() > 1e-3
    assert one.problem.value(other) == pytest.approx(found.objective, rel=1e-13)  # a dozen terms
    with pytest.raises(UncertifiedError, match="valley"):
        _ = store.find_minima(one).lowest_minimum
    for solved in (found.positions, other):
        assert not is_minimum(one.problem, solved)
        assert compute_curvature(one.problem, solved).is_degenerate


def test_a_start_that_is_shaken_is_certified_by_no_eigenvalue_of_another_point(tmp_path):
    """What is stored of it is of the point that is stored: an independent eigensolver finds the same there."""
    _, one = standing(tmp_path)
    rng = np.random.default_rng(2)
    for size in (1e-2, 1e-3):
        shaken = one.problem.current_positions + size * rng.normal(size=one.problem.current_positions.shape)
        found = refine_minimum(one.problem, shaken, NewtonSolver())
        assert not found.is_certified
        least = np.linalg.eigvalsh(build_free_hessian(one.problem, found.positions).toarray())[0]
        assert abs(found.min_eigenvalue - least) <= found.eigenvalue_uncertainty


def test_a_classification_excludes_valleys(tmp_path):
    store, one = standing(tmp_path)
    assert not store.classify_minimum(one, one.problem.current_positions).is_certified
    assert store.find_minima(one).minima == ()
    assert not list(tmp_path.glob("minima-*"))


@pytest.mark.parametrize("name", ["newton_step_length", "min_eigenvalue", "objective"])
def test_a_certificate_is_of_the_very_point_that_is_stored(name: str):
    problem = PROBLEMS["random, pinned by penalty too"]()
    found = refine_minimum(problem, problem.initial_guess, NewtonSolver())
    H = build_free_hessian(problem, found.positions).toarray()
    step = np.linalg.solve(H, problem.gradient(found.positions)[problem.system.free_vertices].ravel()).reshape(-1, 3)
    there = {
        "newton_step_length": np.linalg.norm(step, axis=1).max(),
        "min_eigenvalue": np.linalg.eigvalsh(H)[0],
        "objective": problem.value(found.positions),
    }
    # The step is round-off, by two factors; the eigenvalue to the tolerance of Lanczos.
    assert getattr(found, name) == pytest.approx(there[name], rel=1e-6, abs=1e-14)


def test_minima_that_were_stored_with_less_than_a_certificate_are_found_again(tmp_path):
    one = build_snapshot(PROBLEMS["cloth"]())
    found = ReferenceStore(tmp_path).find_minima(one).lowest_minimum
    path = tmp_path / f"minima-{one.digest}.npz"
    arrays = dict(np.load(path))
    del arrays["eigenvalue_uncertainty"]
    np.savez(path, allow_pickle=False, **arrays)
    assert (
        ReferenceStore(tmp_path).find_minima(one).lowest_minimum.eigenvalue_uncertainty == found.eigenvalue_uncertainty
    )
    assert "eigenvalue_uncertainty" in np.load(path)


def test_an_inaccurate_minimum_states_its_error():
    problem = PROBLEMS["cloth"]()
    best = find_minima(problem, NewtonSolver()).lowest_minimum
    assert "next step" in replace(best, kind=INACCURATE).flaw_description
