"""Measure the operations of barrier contact compared with ipctk, on a cloth folded into four layers that all touch.

    python -m tests.bench.pairs [--sizes 64 128] [--rounds 5] [--publish results/published/pairs]

The gap between layers is 4 mm at 64 vertices a side and proportional to the spacing of vertices. The minimum distance
is a quarter of the gap, and the barrier acts up to 5/4 of the gap. Both programs run interleaved on one thread. The
table has the CPU time of ipctk relative to this project's: the median, the least and the largest ratio of the rounds.
Both have the same active pairs, and merge pairs of the same closest points. ipctk belongs to the extra `dev`.

    value + gradient        with a new search for pairs; and with cached pairs, as in a solver's iterations
    Hessian                 projected to positive semidefinite, with cached pairs: blocks here, a matrix by ipctk
    candidates + safe step  collision-free step size of a step that closes gaps, with LBVH and additive CCD
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.harness.scenes.collision_primitives import find_collision_primitives
from springbench.harness.scenes.mesh.grid_mesh import GridMesh
from springbench.harness.scenes.mesh.mesh import Mesh
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.contact.contact_potential import SelfContact
from springbench.solvers.model.step_problem import Positions

from tests.bench.scripted_study import describe_provenance, publish_rows

CONFIG = Path(__file__).parents[2] / "configs" / "contact.yaml"
GAP, LAYERS = 0.004, 4
"""Distance of layers at 64 vertices a side [m], and number of layers."""


class FoldedSheet(NamedTuple):
    """A folded sheet: mesh at rest, folded positions p (n, 3) [m], displacement d (n, 3) [m], and contact distances."""

    mesh: Mesh
    p: Positions
    d: Positions
    min_distance: float
    dhat: float


def fold_sheet(size: int) -> FoldedSheet:
    """Fold a sheet into layers that lie vertex above vertex, with random perturbations of the positions."""
    mesh, rng = GridMesh(diagonals="one").build_mesh(size), np.random.default_rng(0)
    gap, h, columns = GAP * 63 / (size - 1), 1 / (size - 1), -(-size // LAYERS)
    layer, along = np.divmod(np.arange(size), columns)
    x = np.where(layer % 2 == 0, along, columns - 1 - along) * h
    rows = len(mesh.rest_positions) // size
    p = np.stack([np.tile(x, rows), np.tile(layer * gap, rows), mesh.rest_positions[:, 2]], axis=1)
    p += 0.02 * gap * rng.normal(size=p.shape)
    return FoldedSheet(mesh, p, 0.3 * gap * rng.normal(size=p.shape), 0.25 * gap, gap)


def build_own_work(made: FoldedSheet) -> tuple[dict[str, Callable[[], object]], SelfContact]:
    """Return the timed operations of this project by name, and its contact potential."""
    mesh, p, d, min_distance, dhat = made
    k = np.ones(len(p))
    contact = SelfContact(
        CollisionMesh.from_rest_shape(
            mesh.rest_positions, find_collision_primitives(mesh)[0], mesh.triangles, k, min_distance, dhat
        )
    )

    positions = cycle(
        [p, p + 1e-12, p - 1e-12]
    )  # results at the last two positions are cached, so three miss the cache

    def evaluate_cached() -> float:
        q = next(positions)
        contact.add_gradient(q, np.zeros_like(q))
        return contact.value(q)

    def evaluate_hessian() -> object:
        return contact.hessian_blocks(next(positions), 0.0)

    def evaluate_uncached() -> float:
        contact.candidate_caches.clear()
        return evaluate_cached()

    def compute_step_size() -> float:
        contact.candidate_caches.clear()
        return contact.collision_free_step_size(p, d)

    return {
        "value + gradient": evaluate_uncached,
        "the same, pairs known": evaluate_cached,
        "Hessian": evaluate_hessian,
        "candidates + safe step": compute_step_size,
    }, contact


def build_ipctk_work(made: FoldedSheet) -> tuple[dict[str, Callable[[], object]], int]:
    """Return the timed operations of ipctk by name, and its number of active pairs."""
    import ipctk

    ipctk.set_num_threads(1)
    ipc: Any = ipctk
    mesh, p, d, min_distance, dhat = made
    V, W = np.asfortranarray(p), np.asfortranarray(p + d)
    surface = ipc.CollisionMesh(
        np.asfortranarray(mesh.rest_positions), find_collision_primitives(mesh)[0].astype(np.int32), mesh.triangles
    )
    potential = ipc.BarrierPotential(dhat, 1.0)
    cached = ipc.NormalCollisions()
    cached.build(surface, V, dhat, min_distance, ipc.LBVH())

    def evaluate(collisions: Any) -> float:
        potential.gradient(collisions, surface, V)
        return potential(collisions, surface, V)

    def evaluate_uncached() -> float:
        collisions = ipc.NormalCollisions()
        collisions.build(surface, V, dhat, min_distance, ipc.LBVH())
        return evaluate(collisions)

    def compute_step_size() -> float:
        candidates = ipc.Candidates()
        candidates.build(surface, V, W, 0.5 * min_distance, ipc.LBVH())
        return candidates.compute_collision_free_stepsize(surface, V, W, min_distance, ipc.AdditiveCCD())

    return {
        "value + gradient": evaluate_uncached,
        "the same, pairs known": lambda: evaluate(cached),
        "Hessian": lambda: potential.hessian(cached, surface, V, ipc.PSDProjectionMethod.CLAMP),
        "candidates + safe step": compute_step_size,
    }, len(cached)


def measure_seconds(work: Callable[[], object]) -> float:
    """Measure the CPU time [s] of a call."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def main() -> None:
    """Print a table for each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options, console = parser.parse_args(), Console()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    with limit_threads(1):
        for size in options.sizes:
            made = fold_sheet(size)
            (one, contact), (other, pairs) = build_own_work(made), build_ipctk_work(made)
            table = Table("", "ipctk takes", "between", "ours [ms]", box=SIMPLE_HEAD)
            for name, work in one.items():
                for warm_up in (work, other[name]):  # compiles, and fills the caches
                    warm_up()
                both = [(measure_seconds(work), measure_seconds(other[name])) for _ in range(options.rounds)]
                ratios = sorted(b / a for a, b in both)
                rows += [{"size": size, "operation": name, "time_ratio": ratio} for ratio in ratios]
                ends = f"{ratios[0]:.2f} and {ratios[-1]:.2f}"
                table.add_row(name, f"{median(ratios):.2f} times", ends, f"{1e3 * min(a for a, _ in both):.3g}")
            in_range = len(contact.hessian_blocks(made.p).vertices)
            table.title = (
                f"{size} x {size}: {in_range:,} contacts in range, by ipctk {pairs:,}; {describe_machine().cpu}"
            )
            console.print(table)
    publish_rows(options.publish, CONFIG, rows, begin)


if __name__ == "__main__":
    main()
