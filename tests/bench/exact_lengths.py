"""Measure length errors of augmented vertex block descent after few iterations (Giles, Diaz and Yuksel 2025).

    python -m tests.bench.exact_lengths [--publish results/published/exact-lengths]

There are three tables:

    pendulum          50 links and a bob with 50,000 times the mass of another vertex, released in horizontal position
                      as in figures 7 and 8 of the paper: the largest relative length error of a link, its mean and
                      maximum over two seconds of frames of 1/60 s, and the largest fall of the bob over the length
    two stiffnesses   a chain of 11 springs between fixed ends, every second one 10,000 times as stiff, as in figure 4:
                      its largest distance after four seconds from the solution of Newton's method, over the sag
    one iteration     CPU time of an iteration on the pendulum, relative to that of `vbd`
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from time import thread_time
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.scenes.effects.ether_drag_effect import EtherDragEffect
from springbench.harness.scenes.effects.gravity_effect import GravityEffect
from springbench.harness.scenes.effects.pins_effect import PinsEffect
from springbench.harness.scenes.effects.springs_effect import SpringsEffect
from springbench.harness.scenes.mesh.chain_mesh import ChainMesh
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, simulate_scene
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.position_based.xpbd import Xpbd, XpbdSmallSteps
from springbench.solvers.methods.vertex_block.avbd import AugmentedVertexBlockDescent as Avbd
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent as Vbd
from springbench.solvers.model.energies import spring_energy
from springbench.solvers.model.energies.augmented_lagrangian import concatenate_constraints, length_errors
from springbench.solvers.model.step_problem import PreparedSolver, Solver, StepProblem, StopRule

from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.scene_builders import build_test_scene

CHAIN = Path(__file__).parents[2] / "configs" / "scenes" / "chain.yaml"

FRAME, LINKS, BOB_MASS_RATIO = 1 / 60, 50, 50_000.0
FIRST = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
ENDS = PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"})
STEEP_RAMP = Avbd(stiffness_ramp=1e5, error_stabilisation=0.95)
NEARLY_EXACT = 1e12
"""Stiffness [N/m] for lengths that are exact up to round-off; XPBD supports any stiffness."""


def build_pendulum(stiffness: float | str, mesh: ChainMesh, bob_mass_ratio: float = BOB_MASS_RATIO) -> Scene:
    """Build a chain of vertices of 1 kg and a heavy bob; the stiffness of its springs is in N/m, or `exact`."""
    springs = SpringsEffect.model_validate({"stretch": stiffness, "scaling_rule": "fixed"})
    made = build_test_scene(mesh, springs, GravityEffect(), FIRST, size=LINKS + 1, mass=float(LINKS), time_step=FRAME)
    mass = made.system.mass.copy()
    mass[-1] = bob_mass_ratio * mass[1]
    load = made.constant_force * (mass / made.system.mass)[:, None]
    return replace(made, system=replace(made.system, mass=mass), constant_force=load)


def measure_errors(made: Scene, solver: Solver, iterations: int, seconds: float) -> tuple[float, float, float]:
    """Return the mean and the maximum over time of the largest relative length error, and the relative fall of the bob.

    The fall is the largest, over the length of the chain: 1 for exact lengths. All are infinite if one is not finite.
    """
    lengths = concatenate_constraints(build_pendulum("exact", ChainMesh()).system.length_constraints)
    run = simulate_scene(made, solver.prepare(made.system), StopRule(iterations), initial_guess="inertial",
                   frames=round(seconds / FRAME))  # fmt: skip
    relative_errors = [
        (np.abs(length_errors(lengths, p) / lengths.max_length).max(), -p[-1, 1])
        for p in (step.positions for step in run)
    ]
    found, falls = np.array(relative_errors).T
    if not np.isfinite(found).all():
        return np.inf, np.inf, np.inf
    return float(found.mean()), float(found.max()), float(falls.max() / lengths.max_length.sum())


def measure_pendulum() -> list[dict[str, Any]]:
    """Measure the pendulum: rows with the method, its iterations, the length errors, and the fall of the bob."""
    exact, nearly_exact = (build_pendulum(k, ChainMesh()) for k in ("exact", NEARLY_EXACT))
    # The weight of the bob at rest stretches these springs by .001 and .0001 of their lengths.
    stiff, stiffer = (build_pendulum(BOB_MASS_RATIO * 9.81 * LINKS / stretch, ChainMesh()) for stretch in (1e-3, 1e-4))
    methods = [
        ("avbd", exact, Avbd()),
        ("avbd, stiffness_ramp: 100000, error_stabilisation: 0.95", exact, STEEP_RAMP),
        ("xpbd", nearly_exact, Xpbd()),
        ("xpbd-small-steps", nearly_exact, XpbdSmallSteps()),
        ("vbd, spectral_radius: 0, stretches .001", stiff, Vbd(spectral_radius=0.0)),
        ("vbd, spectral_radius: 0, stretches .0001", stiffer, Vbd(spectral_radius=0.0)),
    ]
    names = ("mean_length_error", "max_length_error", "fall")
    return [
        {"scene": "pendulum", "method": name, "num_iterations": iterations}
        | dict(zip(names, measure_errors(made, solver, iterations, 2.0), strict=True))
        for name, made, solver in methods
        for iterations in (5, 20, 100)
    ]


def measure_stiffness_ratio() -> list[dict[str, Any]]:
    """Measure the chain of two stiffnesses: rows with the method, its iterations, and its error over the sag."""
    chain = build_test_scene(
        ChainMesh(), SpringsEffect(stretch=1e4, scaling_rule="fixed"), GravityEffect(), ENDS,
        EtherDragEffect(decay_rate=2.0),
        size=12, mass=11.0, time_step=FRAME,
    )  # fmt: skip
    (found,) = chain.system.energies
    assert isinstance(found, spring_energy.Springs)
    k = np.where(np.arange(11) % 2, 1e4, 1.0) * found.stiffness
    chain = replace(chain, system=replace(chain.system, energies=(replace(found, stiffness=k),)))

    def simulate_end(solver: Solver, iterations: int) -> np.ndarray:
        """Return the end positions (n, 3) [m]."""
        run = simulate_scene(
            chain, solver.prepare(chain.system), StopRule(iterations), initial_guess="inertial", frames=240
        )
        return [step.positions for step in run][-1]

    reference = simulate_end(NewtonSolver(), 200)
    sag = np.abs(reference - chain.mesh.rest_positions).max()
    methods: dict[str, Solver] = {
        "avbd, softened": Avbd(ramp_spring_stiffness=True),
        "vbd, spectral_radius: 0": Vbd(spectral_radius=0.0),
        "vbd": Vbd(),
        "xpbd": Xpbd(),
    }
    return [
        {"scene": "two stiffnesses", "method": name, "num_iterations": iterations}
        | {"sag_error": float(np.abs(simulate_end(solver, iterations) - reference).max() / sag)}
        for name, solver in methods.items()
        for iterations in (1, 5, 100)
    ]


def measure_iterations() -> list[dict[str, Any]]:
    """Measure an iteration on the pendulum: rows with its CPU time over that of `vbd`."""
    rows = list[dict[str, Any]]()
    stiffnesses = ("exact", NEARLY_EXACT, BOB_MASS_RATIO * 9.81 * LINKS / 1e-3)
    exact, nearly_exact, stiff = (build_pendulum(k, ChainMesh()) for k in stiffnesses)
    baseline = None
    for name, made, solver in (
        ("vbd, spectral_radius: 0", stiff, Vbd(spectral_radius=0.0)),
        ("avbd", exact, Avbd()),
        ("xpbd", nearly_exact, Xpbd()),
    ):
        prepared = solver.prepare(made.system)
        seconds = _measure_iteration(prepared, build_problem(made, build_initial_state(made), "inertial"))
        baseline = baseline or seconds
        rows.append({"scene": "one iteration", "method": name, "cpu_ratio": seconds / baseline})
    return rows


def _measure_iteration(prepared: PreparedSolver, problem: StepProblem) -> float:
    """Return the CPU time [s] of an iteration, the least of five solves with a thousand iterations."""

    def measure_solve() -> float:
        began = thread_time()
        prepared.solve(problem, StopRule(1000))
        return (thread_time() - began) / 1000

    return min(measure_solve() for _ in range(5))


def build_table(rows: list[dict[str, Any]]) -> Table:
    """Build a table of rows with the same columns."""
    table = Table(*(name.replace("_", " ") for name in rows[0]), box=SIMPLE_HEAD)
    for row in rows:
        table.add_row(*(f"{cell:.2g}" if isinstance(cell, float) else str(cell) for cell in row.values()))
    return table


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin = describe_provenance()
    with limit_threads(1):
        tables = measure_pendulum(), measure_stiffness_ratio(), measure_iterations()
    for rows in tables:
        Console(width=120).print(build_table(rows))
    publish_rows(options.publish, CHAIN, [row for rows in tables for row in rows], begin)


if __name__ == "__main__":
    main()
