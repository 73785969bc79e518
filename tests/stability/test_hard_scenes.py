"""Every scene of configs/hard by every solver: refused beforehand and by name, or finite; the objective never rises.

A second solver, prepared apart, repeats a step to the last bit.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from itertools import islice, pairwise
from pathlib import Path

import numba
import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene, load_sweep
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.time_loop import (
    MotionState,
    SimulationStep,
    build_initial_state,
    build_problem,
    prepare,
    simulate_scene,
)
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.model.rounding_bound import gradient_roundoff
from springbench.solvers.model.step_problem import Positions, PreparedSolver, Solver, StepProblem, StopRule, Unsupported
from springbench.solvers.registry import SOLVER_TABLE, SOLVERS, load_target

from tests.scene_builders import THREAD_COUNT, rounding_scale, single_stage_integrator

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
CASES = {path.stem: path for path in sorted((CONFIGS / "hard").glob("*.yaml"))}
ALIKE = {"blanes-moan-4", "blanes-moan-6", "runge-kutta-4", "tsitouras-5", "dormand-prince-8", "avbd", "vbd-ogc"}
"""Methods of the same code as velocity-verlet, and those that give up by themselves where no step reaches an error:
`tests/unit/test_explicit.py`; and what is vbd where no length is exact, `tests/unit/test_avbd.py`, or where no surfaces
are in contact, `tests/unit/test_offset_contact.py`."""
METHODS: dict[str, Solver] = {
    **{name: load_target(target)() for name, target in SOLVERS.items() if name not in ALIKE},
    "numba float32": CompiledLocalGlobal(precision="float32"),
}
TAKE_ALL = {"lbfgs", "hybrid", "newton"}
"""The methods for any energies; others may refuse contact and effects that they do not know, by name."""
REFUSED_SOLVERS = {
    (case, method): "mass"
    for case in ("numbers-massless-vertices", "numbers-mostly-massless")
    for method in SOLVERS
    if method in ("xpbd", "mgpbd") or load_target(SOLVERS[method]).solver_info.is_substepping
}
REFUSED_SOLVERS |= {(case, "velocity-verlet"): "substeps" for case in ("effects-air-drag-1e9", "effects-bending-1e12")}
"""Methods that move each vertex by its own mass cannot move one that has none; explicit ones would take all day."""

FRAMES, ITERATIONS = 2, 8
VALUE = 1e-12
"""Round-off of the objective relative to the sum of its terms' sizes: sums of a thousand terms, each off by 1e-16."""
POSITION_ROUNDOFF = 2e-13
"""Of the largest coordinate: what positions from a triangular solve are off by, a thousand eps. At a minimum an error e
costs |e|_Q^2 / 2, which is all that an iterate may rise by there."""

cases = pytest.mark.parametrize("case", CASES)
methods = pytest.mark.parametrize("method", METHODS)


@lru_cache(maxsize=1)
def scene(case: str, size: int | None = None) -> Scene:
    spec = load_scene(CASES[case])
    return build_scene(spec, size or spec.default_size or 0)


def spacing(made: Scene) -> float:
    """The median rest length [m], or a metre where there are no springs."""
    lengths = made.all_springs.rest_length
    return float(np.median(lengths[lengths > 0.0])) if lengths.any() else 1.0


def bound_gradient_error(stated: StepProblem, p: Positions) -> Positions:
    """What a gradient may be off by (n, 3) [N], vertex by vertex: along an error d a step Q^-1 (g + d) rises by at most
    |Q^-1 d|_Q^2 / 2, because Q majorises."""
    return np.repeat(gradient_roundoff(stated, p)[:, None] / 3**0.5, 3, axis=1)


def prepared_or_refused(made: Scene, solver: Solver) -> PreparedSolver | None:
    """None where the solver refuses the scene, and names one of its energies."""
    energies = {type(energy).__name__ for energy in made.system.energies}
    with suppress(Unsupported):
        return prepare(made, solver)
    with pytest.raises(Unsupported, match=rf"\b({'|'.join(energies)})\b"):
        prepare(made, solver)
    return None


@lru_cache(maxsize=1)
def build_evaluator(case: str) -> ReferenceEvaluator:
    return ReferenceEvaluator(scene(case).system)


def slack(case: str, stated: StepProblem, iterates: list[Positions]) -> float:
    """What round-off may raise the objective by [J]."""
    of_values = VALUE * max(map(stated.value_scale, iterates)) + 0.5 * (POSITION_ROUNDOFF * rounding_scale(stated)) ** 2
    return (
        of_values
        + 0.5 * max(build_evaluator(case).compute_energy_norm(bound_gradient_error(stated, p)) for p in iterates) ** 2
    )


@methods  # which vary faster than the cases, so that each scene is built once
@cases
def test_a_hard_scene_is_refused_by_name_or_stays_finite_descends_and_repeats_itself(case: str, method: str):
    made, solver = scene(case), METHODS[method]
    if (case, method) in REFUSED_SOLVERS:
        with pytest.raises(Unsupported, match=REFUSED_SOLVERS[case, method]):
            prepare(made, solver)
        return
    may_refuse = case.startswith(("contact", "effects", "network")) and method not in TAKE_ALL
    prepared = prepared_or_refused(made, solver) if may_refuse else prepare(made, solver)
    if prepared is None:
        return
    again, state = prepare(made, solver), build_initial_state(made)
    for frame in range(1, FRAMES + 1):
        stated = build_problem(made, state, "previous")
        if solver.is_monotone:
            iterates = [stated.initial_guess, *(p.copy() for p in islice(prepared.iterates(stated), ITERATIONS))]
            values = [stated.value(p) for p in iterates]
            rises = [b - a for a, b in pairwise(values) if not b <= a]
            if rises:
                bound = slack(case, stated, iterates)
                said = f"frame {frame}: the objective rose by {rises} J, {bound:.1e} J being round-off"
                assert all(rise <= bound for rise in rises), said
        for phase in prepared.iteration_phases(stated).values():
            phase()
        solution = prepared.solve(stated, StopRule(ITERATIONS))
        assert np.isfinite(solution.positions).all()
        if frame == 1:
            np.testing.assert_array_equal(again.solve(stated, StopRule(ITERATIONS)).positions, solution.positions)
        state = MotionState(
            single_stage_integrator(made).complete_step(stated.step_start, solution), state.motion, frame
        )


def steps(made: Scene, solver: Solver, iterations: int) -> list[SimulationStep]:
    run = simulate_scene(made, prepare(made, solver), StopRule(iterations), initial_guess="previous", frames=FRAMES)
    return list(run)


SPLIT = {"supernodal": CompiledLocalGlobal("supernodal"), "chosen by size": CompiledLocalGlobal()}
"""What shares its work among threads."""
LARGE = {"geometry-collapsed": 48, "geometry-random": 48, "motion-pins-shake": 48, "geometry-inverted-block": 12}
"""Cases at sizes that have work for two threads."""


@pytest.mark.skipif(THREAD_COUNT < 2, reason="Numba was started with one thread")
@pytest.mark.parametrize("solver", SPLIT.values(), ids=list(SPLIT))
@pytest.mark.parametrize(
    ("case", "size"),
    [*((case, None) for case in CASES if not case.startswith(("contact", "effects-gas"))), *LARGE.items()],
)
def test_any_number_of_threads_gives_the_same_bits(case: str, size: int | None, solver: Solver):
    made, before, found = scene(case, size), numba.get_num_threads(), []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            assert threads == 1 or size is None or "of 2 threads" not in solver.prepare(made.system).description
            found.append(steps(made, solver, ITERATIONS)[-1].positions)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(*found)


COMPILED_CASES = [case for case in CASES if not case.startswith("effects-gas")]
"""What the compiled local-global takes, and solves as well by a factor in single precision."""


LOOSE = {"scales-cubes-1e6-m-apart": 1e-3}
"""Where round-off of the gradient itself, 1e8 N/m times 1e-10 m, moves a free cube by some 1e-4 of the spacing a
step, as processors add up."""


@pytest.mark.parametrize("case", COMPILED_CASES)
def test_a_factor_in_single_precision_leaves_the_motion_where_it_was(case: str):
    """Within 1e-4 of the spacing, also 1e6 m away: the gradient is float64, so that rounding the factor to 6e-8 changes
    an iterate by that part of its last step, not of the positions."""
    made = scene(case)
    double, single = (steps(made, CompiledLocalGlobal(precision=p), 30) for p in ("float64", "float32"))
    for one, other in zip(double, single, strict=True):
        within = LOOSE.get(case, 1e-4) * spacing(made)
        np.testing.assert_allclose(one.positions, other.positions, rtol=0, atol=within)


def test_the_sweep_runs_every_case_by_every_solver():
    sweep = load_sweep(CONFIGS / "hard.yaml")
    options = {(run.scene_name, run.solver.name) for run in sweep.list_runs()}
    assert options == {(case, name) for case in CASES for name in SOLVER_TABLE.keys() - ALIKE}
    assert len(CASES) >= 60
    assert {run.solver.parameters["precision"] for run in sweep.list_runs() if run.solver.name == "numba"} == {
        "float32",
        "float64",
    }
    assert min(run.time_step for run in sweep.list_runs()) <= 1e-4
    assert max(run.time_step for run in sweep.list_runs()) >= 1.0


@cases
def test_a_case_states_why_it_is_hard(case: str):
    assert len(load_scene(CASES[case]).description.split()) >= 5
