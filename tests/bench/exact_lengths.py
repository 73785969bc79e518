"""Length errors of augmented vertex block descent in few iterations (Giles, Diaz and Yuksel 2025).

    python -m tests.bench.exact_lengths [--publish results/published/exact-lengths]

Three tables. A pendulum of 50 links with a bob that is 50,000 times as heavy as a link's vertex, let go level (as in
figures 7 and 8 of the paper): by how much of its length the worst link is off, mean and largest over two seconds of
frames of 1/60 s, and how far the bob falls. A chain of 11 springs between fixed ends, every second one 10,000 times as
stiff (as in figure 4): how far it is after four seconds from where it should be, over its sag. What an iteration of
that pendulum takes.
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

FRAME, LINKS, HEAVY = 1 / 60, 50, 50_000.0
FIRST = PinsEffect.model_validate({"parts": ["first"], "weight": "exact"})
ENDS = PinsEffect.model_validate({"parts": ["ends"], "weight": "exact"})
STEEP = Avbd(stiffness_ramp=1e5, error_stabilisation=0.95)
FIRM = 1e12
"""The stiffness [N/m] of springs that are to be exact: XPBD takes any, and stretches by it are below round-off."""


def pendulum(stiffness: float | str, mesh: ChainMesh, heavy: float = HEAVY) -> Scene:
    """A chain of vertices of a kilogram and a heavy one; stiffness: of its springs [N/m], or `exact`."""
    pinned = SpringsEffect.model_validate({"stretch": stiffness, "scaling_rule": "fixed"})
    made = build_test_scene(mesh, pinned, GravityEffect(), FIRST, size=LINKS + 1, mass=float(LINKS), time_step=FRAME)
    mass = made.system.mass.copy()
    mass[-1] = heavy * mass[1]
    load = made.constant_force * (mass / made.system.mass)[:, None]
    return replace(made, system=replace(made.system, mass=mass), constant_force=load)


def errors(made: Scene, solver: Solver, iterations: int, seconds: float) -> tuple[float, float, float]:
    """The worst link's error over its length, in the mean and at most, and how far the bob falls over the chain's
    length, which is 1 of an exact one; infinite where it is no number."""
    lengths = concatenate_constraints(pendulum("exact", ChainMesh()).system.length_constraints)
    run = simulate_scene(made, solver.prepare(made.system), StopRule(iterations), initial_guess="inertial",
                   frames=round(seconds / FRAME))  # fmt: skip
    relative_errors = [
        (np.abs(length_errors(lengths, p) / lengths.max_length).max(), -p[-1, 1])
        for p in (step.positions for step in run)
    ]
    found, fallen = np.array(relative_errors).T
    if not np.isfinite(found).all():
        return np.inf, np.inf, np.inf
    return float(found.mean()), float(found.max()), float(fallen.max() / lengths.max_length.sum())


def swinging() -> list[dict[str, Any]]:
    """Measure the pendulum: rows with the method, its iterations, the errors of lengths, and the bob's fall."""
    exact, firm = (pendulum(k, ChainMesh()) for k in ("exact", FIRM))
    stiff, stiffer = (
        pendulum(HEAVY * 9.81 * LINKS / by, ChainMesh()) for by in (1e-3, 1e-4)
    )  # stretch by the bob at rest
    of = [
        ("avbd", exact, Avbd()),
        ("avbd, stiffness_ramp: 100000, error_stabilisation: 0.95", exact, STEEP),
        ("xpbd", firm, Xpbd()),
        ("xpbd-small-steps", firm, XpbdSmallSteps()),
        ("vbd, spectral_radius: 0, stretches .001", stiff, Vbd(spectral_radius=0.0)),
        ("vbd, spectral_radius: 0, stretches .0001", stiffer, Vbd(spectral_radius=0.0)),
    ]
    names = ("mean_length_error", "max_length_error", "fall")
    return [
        {"scene": "pendulum", "method": name, "num_iterations": iterations}
        | dict(zip(names, errors(made, solver, iterations, 2.0), strict=True))
        for name, made, solver in of
        for iterations in (5, 20, 100)
    ]


def ratios() -> list[dict[str, Any]]:
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

    def end(solver: Solver, iterations: int) -> np.ndarray:
        run = simulate_scene(
            chain, solver.prepare(chain.system), StopRule(iterations), initial_guess="inertial", frames=240
        )
        return [step.positions for step in run][-1]

    wanted = end(NewtonSolver(), 200)
    sag = np.abs(wanted - chain.mesh.rest_positions).max()
    methods: dict[str, Solver] = {
        "avbd, softened": Avbd(ramp_spring_stiffness=True),
        "vbd, spectral_radius: 0": Vbd(spectral_radius=0.0),
        "vbd": Vbd(),
        "xpbd": Xpbd(),
    }
    return [
        {"scene": "two stiffnesses", "method": name, "num_iterations": iterations}
        | {"sag_error": float(np.abs(end(solver, iterations) - wanted).max() / sag)}
        for name, solver in methods.items()
        for iterations in (1, 5, 100)
    ]


def costs() -> list[dict[str, Any]]:
    """Measure an iteration on the pendulum: rows with its CPU time over that of `vbd`."""
    rows = list[dict[str, Any]]()
    exact, firm, stiff = (pendulum(k, ChainMesh()) for k in ("exact", FIRM, HEAVY * 9.81 * LINKS / 1e-3))
    usual = None
    for name, made, solver in (
        ("vbd, spectral_radius: 0", stiff, Vbd(spectral_radius=0.0)),
        ("avbd", exact, Avbd()),
        ("xpbd", firm, Xpbd()),
    ):
        prepared = solver.prepare(made.system)
        took = _of_one(prepared, build_problem(made, build_initial_state(made), "inertial"))
        usual = usual or took
        rows.append({"scene": "one iteration", "method": name, "cpu_ratio": took / usual})
    return rows


def _of_one(prepared: PreparedSolver, stated: StepProblem) -> float:
    """Processor time [s] of an iteration, the least of five times a thousand."""

    def once() -> float:
        begun = thread_time()
        prepared.solve(stated, StopRule(1000))
        return (thread_time() - begun) / 1000

    return min(once() for _ in range(5))


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
        tables = swinging(), ratios(), costs()
    for rows in tables:
        Console(width=120).print(build_table(rows))
    publish_rows(
        options.publish, CHAIN, "python -m tests.bench.exact_lengths", [row for rows in tables for row in rows], begin
    )


if __name__ == "__main__":
    main()
