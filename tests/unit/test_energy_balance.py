"""The balance of energy: hand-computed motions, what sources give, growth without a source, and a blow-up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.config.sweep_config import RunSpec, SolverSpec
from springbench.harness.experiments.failure_columns import build_energy_growth_columns
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.experiments.sweep_runner import list_failed_runs
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.report.robustness import DIVERGED, ENERGY_GROWTH, classify_run
from springbench.harness.results import parquet_rows
from springbench.harness.scenes.effects.attachments_effect import AttachmentsEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.scenes.scene_spec import SceneSpec
from springbench.harness.simulation.energy_balance import (
    BLOW_UP_FACTOR,
    GROWTH_LIMIT,
    ROUNDOFF_SAFETY,
    EnergyBalance,
    EnergyGain,
    EnergyGrowth,
    compute_frame_balances,
)
from springbench.harness.simulation.time_loop import SimulationStep, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model import integrators
from springbench.solvers.model.step_problem import Positions, StopRule

from tests.scene_builders import build_test_scene

G, DT, CLOSE = 9.81, 0.1, 1e-9
"""Of gravity [m/s^2], a time step [s], and what sums and solves lose of a joule."""
PULL = {"key_frames": [{"time": 0}, {"time": DT, "offset": [-0.2, 0, 0]}]}
"""The pinned end of a chain along x is drawn away from it by 0.2 m in the first step."""


def chain(*effects: Any, time_step: float = DT, **settings: Any) -> Scene:
    """Two masses of 1 kg, one metre apart along x."""
    return build_test_scene(ChainMesh(length=1.0), *effects, size=2, mass=2.0, time_step=time_step, **settings)


def build_pins(weight: str | float = "exact", **settings: Any) -> PinsEffect:
    return PinsEffect.model_validate({"parts": ["first"], "weight": weight, **settings})


def simulate_steps(bound: Scene, frames: int) -> list[SimulationStep]:
    run = simulate_scene(
        bound, prepare(bound, NewtonSolver()), StopRule(100, 1e-12), initial_guess="previous", frames=frames
    )
    return list(run)


def balances(bound: Scene, frames: int) -> list[EnergyGain]:
    balance = EnergyBalance(bound)
    return [balance.add_step(step) for step in simulate_steps(bound, frames)]


def by_midpoint(bound: Scene) -> Scene:
    method = integrators.find_integrator("midpoint")
    return replace(
        bound,
        integrator=method,
        system=replace(bound.system, inertia_factor=method.inertia_factor, velocity_factor=method.velocity_factor),
    )


def replace_end(step: SimulationStep, positions: Positions, velocity: Positions) -> SimulationStep:
    """The same step with another end."""
    now = integrators.Motion(positions, velocity)
    return replace(step, solution=replace(step.solution, positions=positions), state=replace(step.state, motion=now))


def test_free_fall_by_implicit_euler_loses_energy_as_its_formula_states():
    """v = g n dt and a fall of g dt^2 n (n + 1)/2: half of m g^2 dt^2 is lost a step."""
    for n, found in enumerate(balances(chain(GravityEffect()), 5), start=1):
        assert found.gain == pytest.approx(-0.5 * 2.0 * G**2 * DT**2 * n, rel=1e-9)
        assert found.available_energy == pytest.approx(2.0 * G**2 * DT**2 * (0.5 + 0.5 * n * (n + 1)), rel=1e-9)


def test_a_vibration_by_midpoint_has_the_energy_that_it_began_with():
    bound = by_midpoint(
        chain(SpringsEffect(stretch=50.0, scaling_rule="fixed"), build_pins(), velocity=(0.5, 0.0, 0.0))
    )
    before = 1.0
    for step, found in zip(simulate_steps(bound, 6), balances(bound, 6), strict=True):
        now = step.positions[1, 0]
        left, mean = 0.5 * 0.5**2 - 0.5 * 50.0 * (now - 1.0) ** 2, 0.5 * ((now - before) / DT) ** 2
        assert found.gain == pytest.approx(max(left, mean) - 0.5 * 0.5**2, abs=CLOSE)
        before = now
        assert found.available_energy == pytest.approx(0.5 * 0.5**2, abs=CLOSE)


@pytest.mark.parametrize(("weight", "inertia"), [("exact", 0.0), (1e10, 0.2 / DT**2)])
def test_a_pin_that_moves_does_the_work_of_its_force_along_its_displacement(weight: str | float, inertia: float):
    """The free end follows by u = k d/(m/dt^2 + k), so that the spring pulls with k (d - u); what a penalty pins has
    its inertia as well, m d/dt^2."""
    (found,) = balances(chain(SpringsEffect(stretch=50.0, scaling_rule="fixed"), build_pins(weight, motion=PULL)), 1)
    pull = 50.0 * 0.2 * (1.0 - 50.0 / (1.0 / DT**2 + 50.0))
    assert found.available_energy == pytest.approx(ROUNDOFF_SAFETY * 0.2 * (pull + inertia), rel=1e-6)
    assert found.gain < 0.0


def test_points_that_move_give_the_energy_of_their_springs():
    tied = AttachmentsEffect.model_validate({"parts": ["first"], "stiffness": 50.0, "motion": PULL})
    first, second = balances(chain(tied), 2)
    assert first.available_energy == pytest.approx(0.5 * 50.0 * 0.2**2, rel=1e-9)
    assert second.available_energy == pytest.approx(first.available_energy, rel=1e-9)
    assert not second.is_above(0.0)


def drag(times: float) -> Scene:
    """A drag c (u - v) with u = 2 m/s and c = times m/dt, taken where a step starts."""
    return replace(chain(), varying_forces=(lambda p, v, t: times / DT * (np.array([2.0, 0.0, 0.0]) - v),))


def test_a_force_does_work_at_the_mean_velocity():
    """From rest v' = u/2, so that two masses move by u dt/2, against 3/4 of the force that they start with."""
    (found,) = balances(drag(0.5), 1)
    work = 2.0 * (0.75 * 0.5 / DT * 2.0) * (0.5 * 2.0 * DT)
    assert found.available_energy == pytest.approx(ROUNDOFF_SAFETY * work, rel=1e-9)
    assert found.gain == pytest.approx(0.5 * 2.0 * 1.0**2 - work, rel=1e-9)


def test_a_drag_that_turns_the_motion_around_is_no_source():
    """v - u is multiplied by -2 a step."""
    assert balances(drag(3.0), 12)[-1].is_above(GROWTH_LIMIT)
    assert not any(one.is_above(GROWTH_LIMIT) for one in balances(drag(1.5), 12))


def test_a_filter_that_speeds_up_is_a_source():
    (found,) = balances(replace(chain(velocity=(1.0, 0.0, 0.0)), velocity_filters=(lambda v: 2.0 * v,)), 1)
    assert found.gain == pytest.approx(0.0, abs=CLOSE)
    assert found.available_energy == pytest.approx(1.0 + ROUNDOFF_SAFETY * 3.0, rel=1e-9)


def test_stored_energy_counts_where_a_spring_is_longer_than_twice_its_length():
    """A stiff spring that a solve leaves too long stores much, and moves nothing: 10 s are for a slow way there."""
    bound = chain(SpringsEffect(stretch=1e9, scaling_rule="fixed"), GravityEffect(), build_pins(), time_step=10.0)
    (step,) = simulate_steps(bound, 1)
    for length, grows in ((1.5, False), (2.5, True)):
        p = np.array([[0.0, 0.0, 0.0], [length, 0.0, 0.0]])
        found = EnergyBalance(bound).add_step(replace_end(step, p, np.zeros_like(p)))
        assert found.is_above(GROWTH_LIMIT) == grows
    assert found.gain == pytest.approx(0.5 * 1e9 * 1.5**2, rel=1e-6)


def test_a_motion_counts_whatever_velocity_a_solver_claims():
    bound = chain(GravityEffect())
    (step,) = simulate_steps(bound, 1)
    moved = step.problem.current_positions + np.array([1e5, 0.0, 0.0])
    assert EnergyBalance(bound).add_step(replace_end(step, moved, np.zeros_like(moved))).is_above(BLOW_UP_FACTOR)


def test_round_off_is_no_gain():
    bound = chain(SpringsEffect(stretch=50.0, scaling_rule="fixed"))
    (step,) = simulate_steps(bound, 1)
    p = step.problem.current_positions * (1.0 + 4.0 * np.finfo(float).eps)
    v = (p - step.problem.current_positions) / DT
    assert v.any()
    assert not EnergyBalance(bound).add_step(replace_end(step, p, v)).is_above(GROWTH_LIMIT)
    assert EnergyBalance(bound).add_step(replace_end(step, p, 1e6 * v)).is_above(GROWTH_LIMIT)


def test_growth_names_its_first_frame_and_its_largest_ratio():
    rows = {n: {"energy_gain": float(gain), "energy_available": 2.0} for n, gain in enumerate((1, 2, 3, 9, 4), 1)}
    assert EnergyGrowth.from_rows(rows) == EnergyGrowth(first_frame=3, max_ratio=4.5)
    assert EnergyGrowth.from_rows({1: rows[1], 2: rows[2]}) is None


def test_a_motion_at_frames_has_the_balance_of_its_velocities():
    """Free fall with frames of a tenth of a second: as exact, it gains nothing; 1.5 times as fast, 1.25 times the
    energy that was released."""
    bound = replace(chain(GravityEffect()), integrator=integrators.find_integrator("substepping"))
    for factor, gain in ((1.0, 0.0), (1.5, 1.25)):
        motions = list[integrators.Motion]()
        for t in (DT, 2.0 * DT, 3.0 * DT):
            p, v = bound.mesh.rest_positions.copy(), np.zeros((2, 3))
            p[:, 1] -= 0.5 * G * t**2
            v[:, 1] = -factor * G * t
            motions.append(integrators.Motion(p, v))
        *_, last = compute_frame_balances(bound, motions)
        assert last.gain == pytest.approx(gain * 0.5 * 2.0 * (0.3 * G) ** 2, abs=CLOSE)
        assert last.available_energy == pytest.approx(0.5 * 2.0 * G**2 * (0.3**2 + DT**2), rel=1e-9)


LIMIT = """
mesh: {kind: chain, length: 1}
mass: 2
time_step: 1/10
frames: 50
default_size: 2
effects:
  - {kind: springs, scaling_rule: fixed, stretch: 10}
  - {kind: strain-limits, scaling_rule: fixed, max_stretch: 1.05, stiffness: 1e4}
  - {kind: gravity}
  - {kind: pins, parts: [first], weight: exact}
"""
"""A mass that falls into a stiff limit again and again."""
OPTIONS = "options: {frames: 50, rtol: 1e-8, record: %s, pictures: false, timing: %s, integrator: %s}\n"
WRONG = '''from dataclasses import dataclass

from springbench.solvers.model.step_problem import Solution


@dataclass(frozen=True)
class Wrong:
    """Steepest descent with the wrong sign."""

    is_minimiser = True
    is_monotone = False

    def prepare(self, system):
        return Prepared()


class Prepared:
    description, stats = "", {}

    def iterates(self, problem):
        p = problem.initial_guess
        while True:
            p = p + 1e-2 * problem.gradient(p)
            yield p

    def residual_at(self, problem, p):
        return float(abs(problem.gradient(p)).max())

    def iteration_phases(self, problem):
        return {}

    def solve(self, problem, stop):
        p = next(self.iterates(problem))
        return Solution(p, 1, self.residual_at(problem, p), 1.0, "max-iter")
'''


def execute_run_with_limit(
    folder: Path, solver: str, record: str, timing: str, integrator: str
) -> tuple[list[dict[str, Any]], RunFiles]:
    (folder / "limit.yaml").write_text(LIMIT)
    (folder / "wrong.py").write_text(WRONG)
    options = OPTIONS % (record, timing, integrator)
    (folder / "sweep.yaml").write_text(f"scenes: [limit.yaml]\nsolvers: [{solver}]\n{options}")
    (spec,) = load_config(folder / "sweep.yaml").list_runs()
    files = RunFiles.for_run(spec, folder)
    files.rows_path.parent.mkdir()
    return execute_run(spec, files, lambda phase: None), files


@pytest.mark.parametrize(
    ("record", "timing"), [pytest.param("true", "exclusive", marks=pytest.mark.slow), ("false", "none")]
)
def test_a_run_whose_energy_grows_is_reported_in_all_rows(tmp_path: Path, record: str, timing: str):
    found, files = execute_run_with_limit(tmp_path, "newton", record, timing, "midpoint")
    assert {row["status"] for row in found} == {"energy-growth"}
    assert len(list_failed_runs(parquet_rows.read_rows([files.rows_path]))) == 1
    assert "without a source, from frame " in found[0]["reason"]
    assert found[0]["reason"].endswith("a step of 0.1 s is too long for midpoint")
    steps = [row | {"reference_distance": None, "stationarity": None} for row in found if row["phase"] == "step"]
    assert classify_run(steps)[0] is ENERGY_GROWTH
    if record == "true":
        facts = read_replay(files.recording_path).properties
        assert (facts["status"], facts["solver"]) == ("energy-growth", "newton")


@pytest.mark.parametrize(
    ("integrator", "solver", "iterations", "words"),
    [
        ("implicit-euler", "rodas", 1, "a step of 0.1 s is too long for rodas"),
        ("substepping", "velocity-verlet", 60, "a step of 0.1 s is too long for velocity-verlet"),
        ("midpoint", "newton", 3, "a step of 0.1 s is too long for midpoint"),
        ("implicit-euler", "xpbd", 60, "xpbd leaves the step unsolved; take more iterations"),
        ("implicit-euler", "sparse", 60, "sparse leaves the step unsolved; take more iterations"),
    ],
)
def test_the_reason_of_growth_is_the_step_or_its_iterations(integrator: str, solver: str, iterations: int, words: str):
    scene = SceneSpec.model_construct(time_step=0.1)
    run = RunSpec.model_construct(integrator=integrator, solver=SolverSpec(solver, {}), max_iterations=60, scene=scene)
    by_frame = {7: {"termination_reason": "max-iter", "num_iterations": iterations}}
    assert words in build_energy_growth_columns(run, EnergyGrowth(7, 2.0), by_frame)["reason"]


def test_the_same_steps_by_implicit_euler_are_ok(tmp_path: Path):
    found, _ = execute_run_with_limit(tmp_path, "newton", "false", "none", "implicit-euler")
    assert {row["status"] for row in found} == {"ok"}
    assert all(row["energy_gain"] <= 0.0 < row["energy_available"] for row in found if row["phase"] == "step")


def test_a_blow_up_ends_a_run_at_its_first_frame(tmp_path: Path):
    (row,), files = execute_run_with_limit(tmp_path, "./wrong.py:Wrong", "false", "none", "implicit-euler")
    assert (row["status"], row["phase"]) == ("diverged", "run")
    assert f"from frame {row['frame']} on the motion has " in row["reason"]
    assert 1 < row["frame"] < 20
    assert classify_run([row])[0] is DIVERGED
    (line,) = list_failed_runs(parquet_rows.read_rows([files.rows_path]))  # for which the command exits with 1
    assert line == f"limit 2 ./wrong.py:Wrong: diverged: {row['reason']}"
