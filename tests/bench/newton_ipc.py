"""A step of four layers that all touch, by our solvers and a Newton-IPC with ipctk, interleaved on one thread.

    python -m tests.bench.newton_ipc [--sizes 24 64] [--rounds 3] [--publish results/published/newton-ipc]

A cloth folded into four layers (`tests.bench.pairs`), at rest as folded, is thrown at 0.1 m/s onto its lowest layer,
which is pinned: one step of 1/30 s, to a residual |Q^-1 grad g|_Q of a thousandth of that at its start. Printed is how
many times as long Newton-IPC takes, by CPU times, in the middle, and the least and the most of the rounds; how long our
step is in steps of the same solver without contact; and of what Newton-IPC's time is made.

Newton-IPC is that of Li et al. 2020 (algorithm 1): the Hessian of springs and of the barrier clamped element by element
and factorised, steps no longer than additive CCD lets them be, halved until the objective falls, pairs looked up again
at each point. Pairs, values, derivatives and CCD are ipctk's; inertia, springs, the matrix of 3 x 3 blocks, its factor,
the line search and the residual are ours, the same for both. ipctk's barrier is one of squared distances; in the middle
of the range it pushes as ours does. What both prepare once, and compile, is not timed.
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

from tests.bench.pairs import CONFIG, FoldedSheet, fold_sheet, seconds
from tests.bench.scripted_study import describe_provenance, publish_rows

OWN_SOLVERS = ("hybrid", "newton", "lbfgs")
TOLERANCE, MOST = 1e-3, 500
STRETCH, MASS, TIME_STEP, FAST = 1000.0, 0.3, 1 / 30, 0.1
"""[N/m], [kg], [s], [m/s]."""
STIFFNESS = 0.1
"""Of the barriers [N/m], soft enough for layers to be pressed well into their range."""


def build_step(made: FoldedSheet, contact: Energy) -> StepProblem:
    """The step. Vertices of the lowest layer are pinned exactly."""
    mesh, p = made.mesh, made.p
    springs = Springs.from_rest_shape(p, mesh.springs, np.full(len(mesh.springs), STRETCH))
    lowest = np.flatnonzero(p[:, 1] < 0.5 * made.dhat)
    pins = DirichletPins(lowest, np.full(len(lowest), np.inf))
    system = System(MASS * mesh.mass_fractions, TIME_STEP, (springs, contact), pins)
    force, velocity = np.zeros_like(p), np.zeros_like(p)
    force[:, 1], velocity[:, 1] = -9.81 * system.mass, -FAST
    velocity[lowest] = 0.0
    start = StepStart(p, velocity, 0.0, p, system.velocity_rate, TIME_STEP)
    return StepProblem(system, p + TIME_STEP * velocity, force, p[lowest], p, p, start)


class Blocks(NamedTuple):
    """A matrix by its blocks, as an objective takes those of pairs
    (`springbench.solvers.model.barrier_energy.PairBlocks`). vertices (b, 2):
    the row and the column of each; values (b, 3, 3) [N/m]."""

    vertices: NDArray[np.int64]
    values: NDArray[np.float64]

    def add(self, places: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add them to blocks, at places (b, 4) of a row and a column with each of both; -1 where one is pinned."""
        free = places[:, 1] >= 0
        values[places[free, 1]] += self.values[free]


class IpctkTerms(NamedTuple):
    """What ipctk says at p: its collisions, their energy [J] and gradient (n, 3) [N]."""

    p: Positions
    collisions: Any
    value: float
    gradient: Positions


class Ipctk:
    """ipctk's barrier, as an energy that no step passes through. It caches what it found at the last two points.

    neighbours: as of ours, whose matrix this has; spent: CPU time [s] by what it went into.
    """

    def __init__(self, made: FoldedSheet, stiffness: float, surface: CollisionMesh) -> None:
        """stiffness: of our barrier [N/m], the force of which this one has in the middle of the range."""
        import ipctk

        self.candidate_vertices = SelfContact(surface).candidate_vertices
        of: Any = ipctk
        of.set_num_threads(1)
        self._of, self._thickness, self._reach = of, made.min_distance, made.dhat
        edges, triangles = find_collision_primitives(made.mesh)[0].astype(np.int32), made.mesh.triangles
        self._surface = of.CollisionMesh(np.asfortranarray(made.mesh.rest_positions), edges, triangles)
        t, r = made.min_distance, made.dhat
        middle, most = (t + 0.5 * r) ** 2 - t**2, (2.0 * t + r) * r
        slope = (most - middle) * (2.0 * np.log(middle / most) - most / middle + 1.0) * 2.0 * (t + 0.5 * r)
        self._potential = of.BarrierPotential(r, -stiffness * r * (0.5 + np.log(2.0)) / slope)
        self._known: list[IpctkTerms] = []
        self._bent: tuple[Positions, Blocks] | None = None
        self.spent = defaultdict[str, float](float)

    def _measure(self, name: str, work: Callable[[], Any]) -> Any:
        begun = time.process_time()
        out = work()
        self.spent[name] += time.process_time() - begun
        return out

    def _at(self, p: Positions) -> IpctkTerms:
        for found in self._known:
            if np.array_equal(found.p, p):
                return found
        V, collisions = np.asfortranarray(p), self._of.NormalCollisions()
        args = (self._surface, V, self._reach, self._thickness, self._of.LBVH())
        self._measure("pairs", lambda: collisions.build(*args))
        value, gradient = self._measure("value and gradient", lambda: self._slopes(collisions, V))
        found = IpctkTerms(p.copy(), collisions, value, gradient.reshape(-1, 3))
        self._known = [*self._known[-1:], found]
        return found

    def _slopes(self, collisions: Any, V: Any) -> tuple[float, Any]:
        return self._potential(collisions, self._surface, V), self._potential.gradient(collisions, self._surface, V)

    def value(self, p: Positions) -> float:
        """See Energy."""
        return self._at(p).value

    def add_gradient(self, p: Positions, out: Positions) -> None:
        """See Energy."""
        out += self._at(p).gradient

    def hessian(self, p: Positions) -> csr_array:
        """See Energy; clamped."""
        of, V = self._of, np.asfortranarray(p)
        args = (self._at(p).collisions, self._surface, V, of.PSDProjectionMethod.CLAMP)
        H = self._measure("Hessian", lambda: self._potential.hessian(*args))
        return csr_array((H.data, H.indices, H.indptr), shape=H.shape)  # it is symmetric

    def hessian_blocks(self, p: Positions, keep: float = 0.0) -> Blocks:
        """The clamped Hessian."""
        if self._bent is None or not np.array_equal(self._bent[0], p):
            H: Any = self.hessian(p).tobsr((3, 3))
            rows = np.repeat(np.arange(len(p)), np.diff(H.indptr))
            self._bent = p.copy(), Blocks(np.column_stack([rows, H.indices]).astype(np.int64), H.data)
        return self._bent[1]

    def block_vertices(self, p: Positions) -> NDArray[np.int64]:
        """See `springbench.solvers.model.barrier_energy.BarrierEnergy`."""
        return self.hessian_blocks(p).vertices

    def add_hessian_blocks(
        self, p: Positions, keep: float, places: NDArray[np.int64], values: NDArray[np.float64]
    ) -> None:
        """See `springbench.solvers.model.barrier_energy.BarrierEnergy`; clamped."""
        self.hessian_blocks(p).add(places, values)

    def collision_free_step_size(self, p: Positions, direction: Positions) -> float:
        """See `springbench.solvers.model.barrier_energy.BarrierEnergy`."""
        V, W = np.asfortranarray(p), np.asfortranarray(p + direction)
        return self._measure("CCD", lambda: self._safe(V, W))

    def _safe(self, V: Any, W: Any) -> float:
        near = self._of.Candidates()
        near.build(self._surface, V, W, 0.5 * self._thickness, self._of.LBVH())
        return near.compute_collision_free_stepsize(self._surface, V, W, self._thickness, self._of.AdditiveCCD())


SolveResult = tuple[Positions, int]
"""Where a solve ended (n, 3) [m], and after how many iterations."""


def newton_ipc(problem: StepProblem) -> Callable[[], SolveResult]:
    """A solve by Newton-IPC, whose tolerance is satisfied where it ends."""
    metric, whole = ResidualMetric(problem.system), FixedObjective(problem.system)
    assert whole.hessian_matrix.factor.nonzeros  # analysed now, as what ours prepare

    def solve() -> SolveResult:
        step, p = StepObjective(whole, problem), problem.initial_guess
        at, count = DescentPoint(p, step.gradient(p)), 0
        limit = TOLERANCE * metric.residual(at.gradient)
        while metric.residual(at.gradient) > limit:
            hessian = step.hessian(at.positions)
            found = backtracking_line_search(step, at, -hessian.solve(at.gradient)) if hessian.factorise(0.0) else None
            if found is None or count == MOST:
                raise RuntimeError(f"Newton-IPC has not converged in {count} iterations")
            at, count = found, count + 1
        return at.positions, count

    return solve


def build_own_solve(problem: StepProblem, name: str) -> Callable[[], SolveResult | None]:
    """A solve by one of our solvers; None where it does not converge."""
    prepared = load_target(SOLVERS[name])().prepare(problem.system)

    def solve() -> SolveResult | None:
        found = prepared.solve(problem, StopRule(MOST, TOLERANCE))
        return (found.positions, found.num_iterations) if found.termination_reason == "converged" else None

    return solve


def measure_size(size: int, num_rounds: int) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Measure a size: a row for each round and solver, and the shares of Newton-IPC's time."""
    made = fold_sheet(size)
    mesh, k = made.mesh, np.full(len(made.p), STIFFNESS)
    surface = CollisionMesh.from_rest_shape(
        mesh.rest_positions, find_collision_primitives(mesh)[0], mesh.triangles, k, made.min_distance, made.dhat
    )
    problem = build_step(made, SelfContact(surface))
    bare = replace(problem, system=without_barriers(problem.system))
    barrier = Ipctk(made, STIFFNESS, surface)
    theirs = build_step(made, barrier)
    # All is done once, and so compiled and in the caches.
    there, count = newton_ipc(theirs)()
    ends = {name: (build_own_solve(problem, name)(), build_own_solve(bare, name)())[0] for name in OWN_SOLVERS}
    barrier.spent.clear()
    rows, total = list[dict[str, Any]](), 0.0
    for number in range(num_rounds):  # each prepares again: a step stores what it finds out about its matrix's pattern
        other = seconds(newton_ipc(theirs))
        total += other
        for name, end in ends.items():
            row = {"size": size, "solver": name, "round": number, "newton_ipc_iterations": count}
            if end is not None:
                own, without_contact = seconds(build_own_solve(problem, name)), seconds(build_own_solve(bare, name))
                row |= {"num_iterations": end[1], "time_ratio": other / own, "contact_ratio": own / without_contact}
                row |= {"end_distance": float(np.linalg.norm(end[0] - there, axis=1).max() / made.dhat)}
            rows.append(row)
    return rows, {name: spent / total for name, spent in barrier.spent.items()}


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
                table.add_row(name, f"not in {MOST}")
                continue
            ratios = sorted(row["time_ratio"] for row in own)
            longer, away = median(row["contact_ratio"] for row in own), own[0]["end_distance"]
            between = f"{ratios[0]:.2f} and {ratios[-1]:.2f}"
            counts = f"{own[0]['num_iterations']}"
            table.add_row(name, counts, f"{median(ratios):.2f} times", between, f"{longer:.1f}", f"{away:.2g}")
        console.print(table)
        parts = ", ".join(f"{name} {share:.0%}" for name, share in sorted(shares.items(), key=lambda one: -one[1]))
        console.print(f"Of Newton-IPC's time: {parts}; the rest is ours.")
        rows += found
    publish_rows(options.publish, CONFIG, "python -m tests.bench.newton_ipc", rows, begin)


if __name__ == "__main__":
    main()
