"""Contact by pairs compared with ipctk, interleaved on one thread: cloth folded into four layers that all touch.

    python -m tests.bench.pairs [--sizes 64 128] [--rounds 5] [--publish results/published/pairs]

Gaps are 4 mm at 64 vertices a side and go with the spacing; they are felt up to 5/4 of that. Printed is how many times
as long ipctk takes, by CPU times: in the middle, and the least and the most of the rounds. Both have the same pairs in
range, and count closest points that several of them have in common once. ipctk comes with the extra `dev`.

    value + gradient        with the pairs searched again; and with those that a solver's iteration still has
    Hessian                 clamped, with the pairs given: blocks, and of ipctk the matrix
    candidates + safe step  of a step that closes gaps: LBVH and additive CCD
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
"""At 64 vertices a side [m]."""


class FoldedSheet(NamedTuple):
    """mesh: at rest; p (n, 3) [m]: folded; d (n, 3) [m]: a step; min_distance, dhat [m]."""

    mesh: Mesh
    p: Positions
    d: Positions
    min_distance: float
    dhat: float


def fold_sheet(size: int) -> FoldedSheet:
    """Columns go to and fro, one layer above the other, vertex over vertex but for a little noise."""
    mesh, rng = GridMesh(diagonals="one").build_mesh(size), np.random.default_rng(0)
    gap, h, columns = GAP * 63 / (size - 1), 1 / (size - 1), -(-size // LAYERS)
    layer, along = np.divmod(np.arange(size), columns)
    x = np.where(layer % 2 == 0, along, columns - 1 - along) * h
    rows = len(mesh.rest_positions) // size
    p = np.stack([np.tile(x, rows), np.tile(layer * gap, rows), mesh.rest_positions[:, 2]], axis=1)
    p += 0.02 * gap * rng.normal(size=p.shape)
    return FoldedSheet(mesh, p, 0.3 * gap * rng.normal(size=p.shape), 0.25 * gap, gap)


def build_own_work(made: FoldedSheet) -> tuple[dict[str, Callable[[], object]], SelfContact]:
    """What is timed, by name."""
    mesh, p, d, thickness, reach = made
    k = np.ones(len(p))
    contact = SelfContact(
        CollisionMesh.from_rest_shape(
            mesh.rest_positions, find_collision_primitives(mesh)[0], mesh.triangles, k, thickness, reach
        )
    )

    places = cycle([p, p + 1e-12, p - 1e-12])  # what was found at the last two is known, and no more

    def slopes() -> float:
        q = next(places)
        contact.add_gradient(q, np.zeros_like(q))
        return contact.value(q)

    def evaluate_hessian() -> object:
        return contact.hessian_blocks(next(places), 0.0)

    def evaluate_uncached() -> float:
        contact.candidate_caches.clear()
        return slopes()

    def step() -> float:
        contact.candidate_caches.clear()
        return contact.collision_free_step_size(p, d)

    return {
        "value + gradient": evaluate_uncached,
        "the same, pairs known": slopes,
        "Hessian": evaluate_hessian,
        "candidates + safe step": step,
    }, contact


def build_ipctk_work(made: FoldedSheet) -> tuple[dict[str, Callable[[], object]], int]:
    """The same by ipctk, and how many pairs it has in range."""
    import ipctk

    ipctk.set_num_threads(1)
    of: Any = ipctk
    mesh, p, d, thickness, reach = made
    V, W = np.asfortranarray(p), np.asfortranarray(p + d)
    surface = of.CollisionMesh(
        np.asfortranarray(mesh.rest_positions), find_collision_primitives(mesh)[0].astype(np.int32), mesh.triangles
    )
    potential = of.BarrierPotential(reach, 1.0)
    known = of.NormalCollisions()
    known.build(surface, V, reach, thickness, of.LBVH())

    def slopes(found: Any) -> float:
        potential.gradient(found, surface, V)
        return potential(found, surface, V)

    def evaluate_uncached() -> float:
        found = of.NormalCollisions()
        found.build(surface, V, reach, thickness, of.LBVH())
        return slopes(found)

    def step() -> float:
        near = of.Candidates()
        near.build(surface, V, W, 0.5 * thickness, of.LBVH())
        return near.compute_collision_free_stepsize(surface, V, W, thickness, of.AdditiveCCD())

    return {
        "value + gradient": evaluate_uncached,
        "the same, pairs known": lambda: slopes(known),
        "Hessian": lambda: potential.hessian(known, surface, V, of.PSDProjectionMethod.CLAMP),
        "candidates + safe step": step,
    }, len(known)


def seconds(work: Callable[[], object]) -> float:
    """CPU time of this process."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def main() -> None:
    """Measure the times and print them."""
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
                for one_of in (work, other[name]):  # compiled, and in the caches
                    one_of()
                both = [(seconds(work), seconds(other[name])) for _ in range(options.rounds)]
                ratios = sorted(b / a for a, b in both)
                rows += [{"size": size, "operation": name, "time_ratio": ratio} for ratio in ratios]
                ends = f"{ratios[0]:.2f} and {ratios[-1]:.2f}"
                table.add_row(name, f"{median(ratios):.2f} times", ends, f"{1e3 * min(a for a, _ in both):.3g}")
            in_range = len(contact.hessian_blocks(made.p).vertices)
            table.title = (
                f"{size} x {size}: {in_range:,} contacts in range, by ipctk {pairs:,}; {describe_machine().cpu}"
            )
            console.print(table)
    publish_rows(options.publish, CONFIG, "python -m tests.bench.pairs", rows, begin)


if __name__ == "__main__":
    main()
