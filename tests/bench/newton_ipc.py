"""Measure one step of four layers that all touch: this project's solvers compared with Newton-IPC based on ipctk.

    python -m tests.bench.newton_ipc [--sizes 24 64] [--rounds 3] [--publish results/published/newton-ipc]

A cloth folded into four layers (`tests.bench.pairs`), whose springs are at rest when folded, moves at 0.1 m/s towards
its lowest layer, which is pinned. Each solver computes one step of 1/30 s, to a residual |Q^-1 grad g|_Q of a
thousandth of the initial one. All run interleaved on one thread. The table has three quantities, by CPU time without
preparation and compilation:

    Newton-IPC takes       time of Newton-IPC over that of the solver: the median, the least and the largest ratio of
                           the rounds
    steps without contact  time of the solver's step over that of the same step without contact, the median
    ranges from its end    largest distance of a vertex from its position by Newton-IPC, in activation distances

The line below the table has the shares of ipctk's operations in the time of Newton-IPC.

Newton-IPC is algorithm 1 of Li et al. 2020. The Hessians of springs and of the barrier are projected to positive
semidefinite element by element, and their sum is factorised. The step size is limited by additive CCD and halved until
the objective decreases. Collisions are computed again at each iterate. Collisions, barrier values, derivatives and CCD
are those of ipctk. Inertia, springs, the matrix of 3 x 3 blocks, its factorisation, the line search and the residual
are this project's for both. The barrier of ipctk is a function of squared distances; its stiffness is chosen for the
force of this project's barrier at half of the activation distance.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.sparse import csr_array
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.harness.scenes.collision_primitives import find_collision_primitives
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.contact_potential import SelfContact
from springbench.solvers.iteration.descent_method import DescentPoint, ResidualMetric, backtracking_line_search
from springbench.solvers.model.barrier_energy import without_barriers
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import (
    DirichletPins,
    Energy,
    Positions,
    StepProblem,
    StepStart,
    StopRule,
    System,
)
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.pairs import CONFIG, FoldedSheet, fold_sheet, measure_seconds
from tests.bench.scripted_study import describe_provenance, publish_rows

OWN_SOLVERS = ("hybrid", "newton", "lbfgs")
TOLERANCE, MAX_ITERATIONS = 1e-3, 500
STRETCH, MASS, TIME_STEP, SPEED = 1000.0, 0.3, 1 / 30, 0.1
"""Stiffness of springs [N/m], mass [kg], time step [s], and initial speed [m/s]."""
STIFFNESS = 0.1
"""Stiffness of the barriers [N/m], low enough for gaps much smaller than the activation distance."""


def build_step(made: FoldedSheet, contact: Energy) -> StepProblem:
    """Build the problem of the step; vertices of the lowest layer are pinned exactly."""
    mesh, p = made.mesh, made.p
    springs = Springs.from_rest_shape(p, mesh.springs, np.full(len(mesh.springs), STRETCH))
    lowest = np.flatnonzero(p[:, 1] < 0.5 * made.dhat)
    pins = DirichletPins(lowest, np.full(len(lowest), np.inf))
    system = System(MASS * mesh.mass_fractions, TIME_STEP, (springs, contact), pins)
    force, velocity = np.zeros_like(p), np.zeros_like(p)
    force[:, 1], velocity[:, 1] = -9.81 * system.mass, -SPEED
    velocity[lowest] = 0.0
    start = StepStart(p, velocity, 0.0, p, system.velocity_rate, TIME_STEP)
    return StepProblem(system, p + TIME_STEP * velocity, force, p[lowest], p, p, start)


class HessianBlocks(NamedTuple):
    """Blocks of a matrix, in the form of `springbench.solvers.model.barrier_energy.PairBlocks`.

    vertices: row and column of each block (b, 2); values: (b, 3, 3) [N/m].
    """

    vertices: NDArray[np.int64]
    values: NDArray[np.float64]

    def add_blocks(self, block_indices: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add the blocks to those of another matrix.

        block_indices: for each block, those of the pairs (row, row), (row, column), (column, row), (column, column)
        (b, 4), -1 where a vertex is pinned; values: blocks of the other matrix (c, 3, 3) [N/m], updated.
        """
        free = block_indices[:, 1] >= 0
        values[block_indices[free, 1]] += self.values[free]


class IpctkEvaluation(NamedTuple):
    """Evaluation of ipctk's barrier at p (n, 3): its collisions, energy [J] and gradient (n, 3) [N]."""

    p: Positions
    collisions: Any
    value: float
    gradient: Positions


class IpctkBarrier:
    """Barrier of ipctk as an energy that limits step sizes. It caches the evaluations at the last two positions.

    candidate_vertices: that of this project's contact potential, so that both matrices have the same pattern;
    cpu_seconds: CPU time [s] by operation.
    """

    def __init__(self, made: FoldedSheet, stiffness: float, surface: CollisionMesh) -> None:
        """Build the barrier whose force at half of the activation distance is that of this project's barrier.

        stiffness: of this project's barrier [N/m].
        """
        import ipctk

        self.candidate_vertices = SelfContact(surface).candidate_vertices
        ipc: Any = ipctk
        ipc.set_num_threads(1)
        self._ipc, self._min_distance, self._dhat = ipc, made.min_distance, made.dhat
        edges, triangles = find_collision_primitives(made.mesh)[0].astype(np.int32), made.mesh.triangles
        self._surface = ipc.CollisionMesh(np.asfortranarray(made.mesh.rest_positions), edges, triangles)
        t, r = made.min_distance, made.dhat
        # Squared distances less the squared minimum distance, at half of the activation distance and at all of it.
        middle, most = (t + 0.5 * r) ** 2 - t**2, (2.0 * t + r) * r
        slope = (most - middle) * (2.0 * np.log(middle / most) - most / middle + 1.0) * 2.0 * (t + 0.5 * r)
        self._potential = ipc.BarrierPotential(r, -stiffness * r * (0.5 + np.log(2.0)) / slope)
        self._evaluations: list[IpctkEvaluation] = []
        self._last_hessian: tuple[Positions, HessianBlocks] | None = None
        self.cpu_seconds = defaultdict[str, float](float)

    def _measure(self, name: str, work: Callable[[], Any]) -> Any:
        begun = time.process_time()
        out = work()
        self.cpu_seconds[name] += time.process_time() - begun
        return out

    def _evaluate(self, p: Positions) -> IpctkEvaluation:
        for found in self._evaluations:
            if np.array_equal(found.p, p):
                return found
        V, collisions = np.asfortranarray(p), self._ipc.NormalCollisions()
        args = (self._surface, V, self._dhat, self._min_distance, self._ipc.LBVH())
        self._measure("pairs", lambda: collisions.build(*args))
        value, gradient = self._measure("value and gradient", lambda: self._compute_value_and_gradient(collisions, V))
        found = IpctkEvaluation(p.copy(), collisions, value, gradient.reshape(-1, 3))
        self._evaluations = [*self._evaluations[-1:], found]
        return found

    def _compute_value_and_gradient(self, collisions: Any, V: Any) -> tuple[float, Any]:
        return self._potential(collisions, self._surface, V), self._potential.gradient(collisions, self._surface, V)

    def value(self, p: Positions) -> float:
        """Return the barrier energy [J] at p (n, 3) [m]."""
        return self._evaluate(p).value

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """Add the gradient (n, 3) [N] at p (n, 3) [m] to `out`."""
        out += self._evaluate(p).gradient

    def hessian(self, p: Positions) -> csr_array:
        """Return the Hessian (3n, 3n) [N/m] at p, projected to positive semidefinite."""
        V = np.asfortranarray(p)
        args = (self._evaluate(p).collisions, self._surface, V, self._ipc.PSDProjectionMethod.CLAMP)
        H = self._measure("Hessian", lambda: self._potential.hessian(*args))
        return csr_array((H.data, H.indices, H.indptr), shape=H.shape)  # compressed columns are rows by symmetry

    def hessian_blocks(self, p: Positions, negative_fraction: float = 0.0) -> HessianBlocks:
        """Return the blocks of the projected Hessian at p; `negative_fraction` is ignored."""
        if self._last_hessian is None or not np.array_equal(self._last_hessian[0], p):
            H: Any = self.hessian(p).tobsr((3, 3))
            rows = np.repeat(np.arange(len(p)), np.diff(H.indptr))
            blocks = HessianBlocks(np.column_stack([rows, H.indices]).astype(np.int64), H.data)
            self._last_hessian = p.copy(), blocks
        return self._last_hessian[1]

    def block_vertices(self, p: Positions) -> NDArray[np.int64]:
        """Return the row and the column of each Hessian block at p, (b, 2)."""
        return self.hessian_blocks(p).vertices

    def add_hessian_blocks(
        self, p: Positions, negative_fraction: float, block_indices: NDArray[np.int64], values: NDArray[np.float64]
    ) -> None:
        """Add the blocks of the projected Hessian at p to a matrix; `negative_fraction` is ignored."""
        self.hessian_blocks(p).add_blocks(block_indices, values)

    def collision_free_step_size(self, p: Positions, direction: Positions) -> float:
        """Return the largest collision-free step size up to 1 from p along a direction (n, 3) [m]."""
        V, W = np.asfortranarray(p), np.asfortranarray(p + direction)
        return self._measure("CCD", lambda: self._compute_step_size(V, W))

    def _compute_step_size(self, V: Any, W: Any) -> float:
        ipc, candidates = self._ipc, self._ipc.Candidates()
        candidates.build(self._surface, V, W, 0.5 * self._min_distance, ipc.LBVH())
        return candidates.compute_collision_free_stepsize(self._surface, V, W, self._min_distance, ipc.AdditiveCCD())


SolveResult = tuple[Positions, int]
"""End positions (n, 3) [m] of a solve, and its number of iterations."""


def build_newton_ipc_solve(problem: StepProblem) -> Callable[[], SolveResult]:
    """Return a function that solves the step by Newton-IPC; it raises RuntimeError if it does not converge."""
    metric, fixed = ResidualMetric(problem.system), FixedObjective(problem.system)
    assert fixed.hessian_matrix.factor.nonzeros  # runs the symbolic factorisation, which other solvers prepare as well

    def solve() -> SolveResult:
        step, p = StepObjective(fixed, problem), problem.initial_guess
        at, count = DescentPoint(p, step.gradient(p)), 0
        limit = TOLERANCE * metric.residual(at.gradient)
        while metric.residual(at.gradient) > limit:
            hessian = step.hessian(at.positions)
            found = backtracking_line_search(step, at, -hessian.solve(at.gradient)) if hessian.factorise(0.0) else None
            if found is None or count == MAX_ITERATIONS:
                raise RuntimeError(f"Newton-IPC has not converged in {count} iterations")
            at, count = found, count + 1
        return at.positions, count

    return solve


def build_own_solve(problem: StepProblem, name: str) -> Callable[[], SolveResult | None]:
    """Return a function that solves the step by one of OWN_SOLVERS, or returns None if it does not converge."""
    prepared = load_target(SOLVERS[name])().prepare(problem.system)

    def solve() -> SolveResult | None:
        found = prepared.solve(problem, StopRule(MAX_ITERATIONS, TOLERANCE))
        return (found.positions, found.num_iterations) if found.termination_reason == "converged" else None

    return solve


def measure_size(size: int, num_rounds: int) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Measure a mesh size: a row for each round and solver, and the shares of operations in Newton-IPC's time."""
    made = fold_sheet(size)
    mesh, k = made.mesh, np.full(len(made.p), STIFFNESS)
    surface = CollisionMesh.from_rest_shape(
        mesh.rest_positions, find_collision_primitives(mesh)[0], mesh.triangles, k, made.min_distance, made.dhat
    )
    problem = build_step(made, SelfContact(surface))
    contact_free = replace(problem, system=without_barriers(problem.system))
    barrier = IpctkBarrier(made, STIFFNESS, surface)
    ipctk_problem = build_step(made, barrier)
    # A first run of all solves compiles them and fills the caches.
    ipctk_end, count = build_newton_ipc_solve(ipctk_problem)()
    ends = {name: (build_own_solve(problem, name)(), build_own_solve(contact_free, name)())[0] for name in OWN_SOLVERS}
    barrier.cpu_seconds.clear()
    rows, total = list[dict[str, Any]](), 0.0
    for number in range(num_rounds):  # each round prepares again, since a solve caches the pattern of its matrix
        other = measure_seconds(build_newton_ipc_solve(ipctk_problem))
        total += other
        for name, end in ends.items():
            row = {"size": size, "solver": name, "round": number, "newton_ipc_iterations": count}
            if end is not None:
                own, without_contact = (measure_seconds(build_own_solve(one, name)) for one in (problem, contact_free))
                row |= {"num_iterations": end[1], "time_ratio": other / own, "contact_ratio": own / without_contact}
                row |= {"end_distance": float(np.linalg.norm(end[0] - ipctk_end, axis=1).max() / made.dhat)}
            rows.append(row)
    return rows, {name: seconds / total for name, seconds in barrier.cpu_seconds.items()}


def main() -> None:
    """Print a table for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[24, 64])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options, console = parser.parse_args(), Console(highlight=False)
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    for size in options.sizes:
        with limit_threads(1):
            found, shares = measure_size(size, options.rounds)
        columns = ("", "iterations", "Newton-IPC takes", "between", "steps without contact", "ranges from its end")
        title = (
            f"{size} x {size}: Newton-IPC in {found[0]['newton_ipc_iterations']} iterations; {describe_machine().cpu}"
        )
        table = Table(*columns, title=title, box=SIMPLE_HEAD)
        for name in OWN_SOLVERS:
            own = [row for row in found if row["solver"] == name]
            if "time_ratio" not in own[0]:
                table.add_row(name, f"not in {MAX_ITERATIONS}")
                continue
            ratios = sorted(row["time_ratio"] for row in own)
            longer, away = median(row["contact_ratio"] for row in own), own[0]["end_distance"]
            between = f"{ratios[0]:.2f} and {ratios[-1]:.2f}"
            counts = f"{own[0]['num_iterations']}"
            table.add_row(name, counts, f"{median(ratios):.2f} times", between, f"{longer:.1f}", f"{away:.2g}")
        console.print(table)
        parts = ", ".join(f"{name} {share:.0%}" for name, share in sorted(shares.items(), key=lambda one: -one[1]))
        console.print(f"Of Newton-IPC's time: {parts}; the rest is code of this project.")
        rows += found
    publish_rows(options.publish, CONFIG, rows, begin)


if __name__ == "__main__":
    main()
