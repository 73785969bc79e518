"""Dissipation by cause: closed forms of single steps, and a balance that closes on the shipped scenes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget, prepare_candidate_methods
from springbench.harness.experiments.error_control.method_trials import Trial
from springbench.harness.report.sweep_summary import summarise_sweep
from springbench.harness.report.timing_table import read_run_times
from springbench.harness.results.run_schema import RUN_SCHEMA
from springbench.harness.scenes.effects.air_drag_effect import AirDragEffect
from springbench.harness.scenes.effects.dashpots_effect import DashpotsEffect
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.scenes.start_positions import RestStart
from springbench.harness.simulation.energy_balance import DissipationBudget, StepDissipation, sum_dissipation
from springbench.harness.simulation.time_loop import (
    MotionState,
    SimulationStep,
    build_initial_state,
    build_integrated_step,
    build_problem,
    prepare,
    simulate_scene,
)
from springbench.solvers.model import integrators
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import DirichletPins, Positions, StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.scene_builders import build_test_scene

DT, CONVERGED_STOP = 0.05, StopRule(100, 1e-12)
ROUND_OFF = 1e-12
"""Of a balance, relative to the energies in it: a few hundred sums of float64, each within 2e-16."""
SPRINGS = SpringsEffect(stretch=50.0, scaling_rule="fixed")
FIRST_PIN = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
SCENES = Path("configs/scenes")
CONSERVATIVE = ("curtain", "single-spring", "stiff-cloth-sway")
"""Scenes without damping, friction and sources."""
DRIVEN_SCENES = ("hanging-cloth", "flag-in-gusts", "heavy-bob", "rope-bridge", "spinning-skirt", "tower")


def pendulum(*effects: Any, integrator: str = "implicit-euler", **settings: Any) -> Scene:
    """A mass of 1 kg on a spring of 1 m, pinned at its other end, that falls from the horizontal."""
    scene = build_test_scene(
        ChainMesh(length=1.0),
        *(effects or (SPRINGS, FIRST_PIN, GravityEffect())),
        size=2,
        mass=2.0,
        time_step=DT,
        **settings,
    )
    method = integrators.find_integrator(integrator)
    system = replace(scene.system, inertia_factor=method.inertia_factor, velocity_factor=method.velocity_factor)
    return replace(scene, integrator=method, system=system)


def observe(
    scene: Scene, frames: int, solver: str = "newton", stop: StopRule = CONVERGED_STOP
) -> list[tuple[SimulationStep, StepDissipation]]:
    budget, prepared = DissipationBudget(scene), prepare(scene, load_target(SOLVERS[solver])())
    run = simulate_scene(scene, prepared, stop, initial_guess="previous", frames=frames)
    return [(step, budget.add_step(step)) for step in run]


def build_shipped_scene(name: str, integrator: str = "implicit-euler") -> Scene:
    spec = load_scene(SCENES / f"{name}.yaml")
    return build_scene(spec, min(spec.default_size or 8, 8), integrator)


def make_pins_exact(scene: Scene) -> Scene:
    pins = DirichletPins(scene.system.pins.vertices, np.full(len(scene.system.pins.vertices), np.inf))
    return replace(scene, system=replace(scene.system, pins=pins))


def size_of(found: StepDissipation) -> float:
    """Scale of the terms of a balance [J]."""
    return sum(abs(value or 0.0) for value in found[:-1])


def test_implicit_euler_dissipates_as_its_formula_states():
    """1/2 |v' - v|^2 m + U(p) - U(p') - grad U(p') . (p - p')."""
    scene = pendulum()
    springs = next(energy for energy in scene.system.energies if isinstance(energy, Springs))
    found = observe(scene, 6)
    for (before, _), (step, now) in pairwise(found):
        change, gradient = step.positions - before.positions, np.zeros((2, 3))
        springs.add_gradient(step.positions, gradient)
        kinetic = 0.5 * float(np.sum((step.state.motion.velocity - before.state.motion.velocity)[1] ** 2))
        stored = springs.value(before.positions) - springs.value(step.positions) + float(np.sum(gradient * change))
        assert now.dissipation_integrator == pytest.approx(kinetic + stored, rel=1e-9)
        assert now.dissipation_damping == now.dissipation_friction == now.source_work == 0.0


def test_midpoint_dissipates_nothing_of_a_linear_motion():
    """A free fall, and a spring that swings along itself, of which implicit Euler takes a third and more."""
    for effects, speed in (((GravityEffect(),), 1.0), ((SPRINGS, FIRST_PIN), 0.1)):
        by = {
            name: observe(pendulum(*effects, integrator=name, velocity=(speed, 0.0, 0.0)), 20)
            for name in ("midpoint", "implicit-euler")
        }
        lost = {name: sum(now.dissipation_integrator or 0.0 for _, now in found) for name, found in by.items()}
        provided = by["implicit-euler"][-1][1].provided_energy or 0.0
        assert abs(lost["midpoint"]) < 1e-10 * provided
        assert lost["implicit-euler"] > 0.03 * provided


def test_damping_dissipates_as_its_formula_states():
    """Dashpots c |n.v|^2 dt; drag of all vertices c m v^2 dt; a filter takes kinetic energy before the step."""
    (step, found), *_ = observe(
        pendulum(SPRINGS, FIRST_PIN, DashpotsEffect(stretch=2.0, scaling_rule="fixed"), velocity=(1, 0, 0)), 1
    )
    assert found.dissipation_damping == pytest.approx(2.0 * step.state.motion.velocity[1, 0] ** 2 * DT, rel=1e-9)
    (_, found), *_ = observe(pendulum(EtherDragEffect(decay_rate=2.0), velocity=(1.0, 0.0, 0.0)), 1)
    assert found.dissipation_damping == pytest.approx(1.0 - np.exp(-4.0 * DT), rel=1e-9)
    (step, found), *_ = observe(pendulum(AirDragEffect(coefficient=0.5), velocity=(1.0, 0.0, 0.0)), 1)
    assert found.dissipation_damping == pytest.approx(0.5 * step.state.motion.velocity[0, 0] ** 2 * DT, rel=1e-9)


@pytest.mark.parametrize("name", [*DRIVEN_SCENES, *CONSERVATIVE])
def test_the_balance_closes_to_round_off_in_every_frame(name: str):
    found = [now for _, now in observe(build_shipped_scene(name), 5, stop=StopRule(20, 1e-6))]
    assert all(abs(now.balance_error or 0.0) <= ROUND_OFF * size_of(now) for now in found)
    assert all(now.balance_error is not None for now in found)


@pytest.mark.parametrize("integrator", ["midpoint", "bdf2", "sdirk-4", "esdirk-4", "tr-bdf2", "newmark", "hht"])
def test_the_balance_closes_by_every_integrator(integrator: str):
    found = [now for _, now in observe(build_shipped_scene("hanging-cloth", integrator), 3, stop=StopRule(20, 1e-6))]
    assert all(abs(now.balance_error or 0.0) <= ROUND_OFF * size_of(now) for now in found)


class _PulledPin(RestStart):
    """The rest shape with its pinned vertex away from its target."""

    def compute_positions(self, rest_positions: Positions) -> Positions:
        p = rest_positions.copy()
        p[0] += (0.1, 0.2, 0.0)
        return p


@pytest.mark.parametrize(
    ("integrator", "weight"),
    [
        *((name, "exact") for name in ("implicit-euler", "bdf2", "sdirk-4", "esdirk-3", "tr-bdf2")),
        ("implicit-euler", 1e10),
        ("sdirk-4", 1e10),
    ],
)
def test_pins_that_the_start_has_displaced_are_projected_before_the_motion(integrator: str, weight: str | float):
    """All else is at rest: its springs have been strained by the pin alone, and no one gives or takes energy."""
    pins = PinsEffect.model_validate({"parts": ["first"], "weight": weight})
    scene = replace(pendulum(SPRINGS, pins, integrator=integrator), start=_PulledPin())
    found = [now for _, now in observe(scene, 3)]
    jump = 25.0 * (float(np.hypot(0.9, 0.2)) - 1.0) ** 2
    for now in found:
        assert abs(now.dissipation_integrator or 0.0) + abs(now.dissipation_solve or 0.0) < 1e-9 * jump
        assert (now.provided_energy or 0.0) < 1e-6 * jump
        assert abs(now.balance_error or 0.0) <= ROUND_OFF * max(1.0, size_of(now))


@pytest.mark.parametrize("integrator", ["implicit-euler", "midpoint", "esdirk-3", "esdirk-4"])
def test_a_perturbed_start_is_dissipated_alike_with_exact_and_penalty_pins(integrator: str):
    """Energy that a method of order 4 takes is a hundredth; accelerations of penalties were 10^4 times all energy."""
    lost = list[float]()
    for scene in (
        build_shipped_scene("spinning-skirt", integrator),
        make_pins_exact(build_shipped_scene("spinning-skirt", integrator)),
    ):
        found = [now for _, now in observe(scene, 3)]
        assert all(abs(now.balance_error or 0.0) <= ROUND_OFF * size_of(now) for now in found)
        lost.append(sum(now.dissipation_integrator or 0.0 for now in found) / (found[-1].provided_energy or 1.0))
    assert lost[0] == pytest.approx(lost[1], rel=0.03, abs=2e-3)
    assert abs(lost[0]) < 0.05 or integrator in ("implicit-euler", "esdirk-3")


def test_energies_of_the_last_frame_are_those_of_the_start_plus_all_terms():
    """The sum over frames, with energies of the ends from positions and velocities alone."""
    scene = build_shipped_scene("curtain")
    found = observe(scene, 8, "sparse", StopRule(3))
    last, start = found[-1][1], scene.mesh.rest_positions
    dissipated = sum(now.dissipated_energy for _, now in found)
    p, v = found[-1][0].state.motion
    stored = sum(energy.value(p) - energy.value(start) for energy in scene.system.energies)
    kinetic = 0.5 * float(scene.system.mass @ np.sum(v**2, axis=1))
    load = float(np.sum(scene.constant_force * (p - start)))
    soft, vertices, weight = scene.system.penalty_pins
    pins = 0.5 * float(weight @ np.sum((p[vertices] - scene.pin_targets[soft]) ** 2, axis=1))
    assert kinetic + stored + pins - load == pytest.approx(-dissipated, rel=1e-9)
    assert last.dissipation_solve != pytest.approx(0.0, abs=1e-3 * (last.provided_energy or 0.0))


def test_an_unconverged_solve_takes_more_than_a_converged_one():
    lost = [
        sum(
            abs(now.dissipation_solve or 0.0)
            for _, now in observe(build_shipped_scene("hanging-cloth"), 5, "sparse", StopRule(n))
        )
        for n in (2, 20, 200)
    ]
    assert lost[0] > 3.0 * lost[1] > 9.0 * lost[2]


@pytest.mark.slow
def test_contact_is_separated_from_friction():
    """A block on a slope: what friction takes is its force times the way, and obstacles at rest do no work."""
    found = [now for _, now in observe(build_shipped_scene("block-slide"), 25)]
    assert all(abs(now.balance_error or 0.0) <= ROUND_OFF * size_of(now) for now in found)
    assert sum(now.dissipation_friction or 0.0 for now in found) > 0.1 * (found[-1].provided_energy or 0.0)
    assert max(abs(now.source_work or 0.0) for now in found) == 0.0


@pytest.mark.slow
def test_obstacles_that_move_are_sources():
    found = [now for _, now in observe(build_shipped_scene("net-catches-ball"), 40)]
    assert all(abs(now.balance_error or 0.0) <= ROUND_OFF * size_of(now) for now in found)
    assert sum(now.source_work or 0.0 for now in found) > 0.0


def test_tensions_of_exact_lengths_do_no_work_as_a_residual():
    scene = pendulum(SpringsEffect(stretch="exact"), FIRST_PIN, GravityEffect())
    found = [now for _, now in observe(scene, 10, "avbd", StopRule(400, 1e-12))]
    assert all(abs(now.balance_error or 0.0) <= ROUND_OFF * size_of(now) for now in found)
    assert max(abs(now.dissipation_solve or 0.0) for now in found) < 1e-6
    assert sum(now.dissipation_integrator or 0.0 for now in found) > 0.1


@pytest.mark.parametrize("name", ["curtain", "hanging-cloth", "flag-in-gusts", "spinning-skirt"])
def test_an_accurate_integrator_of_frames_takes_no_more_than_the_error_of_its_quadrature(name: str):
    """Dormand and Prince's method is exact to 1e-6 here: what it seems to take is the error of the other terms."""
    for step, now in observe(build_shipped_scene(name, "substepping"), 5, "dormand-prince-8"):
        assert abs(now.dissipation_integrator or 0.0) <= 4.0 * (now.balance_error or 0.0) + 1e-6 * size_of(now)
        assert (now.balance_error or 0.0) <= 1e-3 * size_of(now)
        assert now.dissipation_solve is now.dissipation_engine is None
        change = step.positions - step.problem.step_start.positions
        assert now.source_work != 0.0 or name in CONSERVATIVE or not change[step.problem.system.pins.vertices].any()


def test_damping_within_frames_is_that_of_small_steps():
    """The drag of a pendulum in three frames, against implicit Euler with steps a twentieth as long."""
    effects = SPRINGS, FIRST_PIN, GravityEffect(), AirDragEffect(coefficient=0.5)
    frames = [now for _, now in observe(pendulum(*effects, integrator="substepping"), 3, "dormand-prince-8")]
    scene = pendulum(*effects)
    scene = replace(scene, system=replace(scene.system, time_step=DT / 20))
    steps = [now for _, now in observe(scene, 60)]
    lost = [sum(now.dissipation_damping or 0.0 for now in found) for found in (frames, steps)]
    assert lost[0] == pytest.approx(lost[1], rel=0.1)  # of first order
    assert sum(now.dissipated_energy for now in frames) == pytest.approx(lost[0], rel=1e-3)


def test_an_engine_takes_what_its_integrator_and_solves_take_together():
    scene = pendulum(integrator="substepping")
    budget, before = DissipationBudget(scene, has_inner_solves=True), build_initial_state(scene)
    fall = np.array([[0.0, 0.0, 0.0], [0.0, -0.5 * DT**2 * 9.81, 0.0]])
    after = MotionState(Motion(before.motion.positions + fall, 0.9 * 2.0 * fall / DT), None, 1)
    now = budget.add_step(build_integrated_step(build_problem(scene, before, "previous"), after))
    assert now.dissipation_integrator is now.dissipation_solve is None
    free, stored = 0.5 * (9.81 * DT) ** 2, 25.0 * (float(np.linalg.norm([1.0, fall[1, 1]])) - 1.0) ** 2
    assert now.dissipation_engine == pytest.approx((1.0 - 0.81) * free - stored, rel=1e-9)


@pytest.mark.parametrize(("method", "solver"), [("esdirk-4", "newton"), ("midpoint", "newton"), ("", "rodas")])
def test_frames_have_the_dissipation_of_the_steps_that_end_in_them(method: str, solver: str):
    """Frames of an error-controlled motion: energies of the last are those of the start plus all terms."""
    target = ErrorTarget(load_scene(SCENES / "hanging-cloth.yaml"), 5, 0.5, 10)
    (found,) = prepare_candidate_methods(target, print, [(method or "substepping", SolverSpec(solver, {}))])
    trial = Trial(found, found.stepper.initial_setting(1e-3), Any, 0.0, 1.0)  # type: ignore[arg-type]
    by_frame = trial.measure_dissipation(target.frame_seconds)
    assert sorted(by_frame) == list(range(1, 11))
    total = sum_dissipation(by_frame)
    assert total.kinetic_energy + (total.potential_energy or 0.0) == pytest.approx(-total.dissipated_energy, rel=1e-9)
    assert (total.dissipation_damping or 0.0) > 0.0
    assert (total.dissipation_solve is None) == (solver == "rodas")


@pytest.mark.long
@pytest.mark.parametrize(
    "path", [*sorted(SCENES.rglob("*.yaml")), Path("configs/teaching/handout.json")], ids=lambda path: path.stem
)
def test_the_balance_closes_on_every_shipped_scene(path: Path):
    """With contact and friction too, whose forces are those of the step's last round."""
    spec = load_scene(path)
    scene = build_scene(spec, min(spec.default_size or 9, 9))
    solver = "avbd" if scene.system.length_constraints else "newton"
    found = [now for _, now in observe(scene, min(spec.frames, 40), solver, StopRule(30, 1e-6))]
    for now in found:
        assert now.balance_error is not None
        assert abs(now.balance_error) <= ROUND_OFF * size_of(now)


def test_the_summary_states_where_the_energy_went():
    lost = {
        "dissipation_damping": 0.02,
        "dissipation_friction": 0.0,
        "dissipation_integrator": 0.03,
        "dissipation_solve": 0.01,
    }
    same = {"run_id": "a", "scene": "cloth", "size": 8, "solver": "sparse", "parameters": "{}", "status": "ok"}
    same |= {"integrator": "implicit-euler", "time_step": 0.1, "phase": "step", "seconds": 1e-3, "provided_energy": 1.0}
    rows = [same | lost | {"frame": k, "round": n} for k in range(1, 11) for n in (0, 1)]
    (run,) = read_run_times(pa.Table.from_pylist(rows, schema=RUN_SCHEMA))
    assert run.dissipation_shares == pytest.approx((0.2, 0.0, 0.3, 0.1, 0.0))
    words = " ".join(line.strip() for line in summarise_sweep([run]))
    assert "cloth: implicit-euler took 30 % of the energy in 1 s, damping effects 20 %; half the time step" in words
    assert "Unconverged solves took up to 10 % of the energy (sparse on cloth 8, " in words
    engine = lost | {"dissipation_integrator": None, "dissipation_solve": None, "dissipation_engine": 0.04}
    rows = [row | engine | {"solver": "mujoco"} for row in rows]
    (run,) = read_run_times(pa.Table.from_pylist(rows, schema=RUN_SCHEMA))
    words = " ".join(line.strip() for line in summarise_sweep([run]))
    assert (
        "cloth: mujoco took 40 % of the energy in 1 s by its integrator and its solves, damping effects 20 %." in words
    )
    assert "Unconverged" not in words
