"""What contact costs while nothing is near: steps of cloth with contact over steps without.

    python -m tests.bench.idle_contact [--tables steps broad-phases] [--sizes 33 64 128] [--solvers hybrid newton]
        [--scenes cloth flag] [--publish results/published/idle-contact]

steps           The swinging cloth and the flag are simulated to a relative residual of 1e-6: with self-contact, with
                surface contact to a plane 5 m below, and without. Both simulations advance one step each in turn on one
                thread, in several rounds. The ratio is that of the processor times of all steps after the first two, up
                to the first in which contact acts. Of each step the least time of the rounds counts.
broad-phases    Three ways to certify that a step with self-contact is free of collisions and ends without active pairs:
                affine clusters, the hierarchy of boxes, and a list of the pairs within a skin, which is made again
                where two vertices may have moved relative to each other by more than the skin. The best of several
                skins counts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import pairwise, product
from pathlib import Path
from time import thread_time
from typing import Any, NamedTuple

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.harness.scenes.effects.effect_interface import SceneEffect
from springbench.harness.scenes.effects.self_contact_effect import SelfContactEffect
from springbench.harness.scenes.effects.surface_contact_effect import SurfaceContactEffect
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.time_loop import prepare, simulate_scene
from springbench.solvers.contact import ccd
from springbench.solvers.contact.ccd import MIN_GAP_FRACTION
from springbench.solvers.contact.collisions import Candidates, pad_positions
from springbench.solvers.contact.contact_potential import SelfContact
from springbench.solvers.contact.geometry.aabb import CollisionQuery
from springbench.solvers.contact.potentials.barrier import compute_distances
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.model.step_problem import Positions, StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

SCENES = Path(__file__).parents[2] / "configs" / "scenes"
CLOTHS = {"cloth": "hanging-cloth.yaml", "flag": "flag-in-wind.yaml"}
CONTACTS: dict[str, SceneEffect] = {
    "self-contact": SelfContactEffect(min_distance=0.002, friction=0.3),
    "surface-contact": SurfaceContactEffect.model_validate(
        {"obstacles": [{"kind": "plane", "point": (0, -5, 0)}], "min_distance": 0.005, "friction": 0.3}
    ),
}
STOP, NUM_WARMUP_STEPS = StopRule(5000, 1e-6), 2
SKIN_FACTORS, MAX_LIST_PAIRS = (2.0, 5.0, 10.0, 20.0, 40.0), 2_000_000
"""Skins of lists, in activation distances."""


def measure_step_ratio(
    cloth: str, effect: SceneEffect, size: int, solver: str, frames: int, rounds: int
) -> tuple[float, int, float]:
    """Return the ratio of processor times with an effect to those without, the number of steps, and a step's time [s].

    Args:
        cloth: name of the scene.
        effect: kind of contact.
        size: mesh size.
        solver: name of the solver.
        frames: largest number of steps.
        rounds: number of repetitions.
    """
    spec = load_scene(SCENES / CLOTHS[cloth])
    both = [spec.model_copy(update={"effects": (*spec.effects, *more)}) for more in ((effect,), ())]
    scenes = [build_scene(one, size, log_warnings=False) for one in both]
    prepared = [prepare(scene, load_target(SOLVERS[solver])()) for scene in scenes]
    least = np.full((frames, 2), np.inf)
    for number in range(rounds):
        steps = [
            iter(simulate_scene(*it, STOP, initial_guess="previous", frames=frames))
            for it in zip(scenes, prepared, strict=True)
        ]
        for k in range(len(least)):
            found: dict[int, Positions] = {}
            for j in (0, 1) if (k + number) % 2 else (1, 0):
                began = thread_time()
                found[j] = next(steps[j]).positions
                least[k, j] = min(least[k, j], thread_time() - began)
            if not np.array_equal(found[0], found[1]):
                least = least[:k]
                break
    least = least[NUM_WARMUP_STEPS:]
    with_contact, without = least.sum(axis=0).tolist()
    return with_contact / without, len(least), without / len(least)


class BroadPhases(NamedTuple):
    """Processor time [ms] of a step's certificate by method; skin [m]: that of the list, nan where none suffices."""

    clusters: float
    boxes: float
    pair_list: float
    skin: float


def measure_broad_phases(cloth: str, size: int, frames: int) -> BroadPhases:
    """Measure certificates of the steps of a motion without contact."""
    spec = load_scene(SCENES / CLOTHS[cloth])
    scene = build_scene(spec, size, log_warnings=False)
    contact = spec.model_copy(update={"effects": (*spec.effects, CONTACTS["self-contact"])})
    (mesh,) = (
        energy.collision_mesh
        for energy in build_scene(contact, size, log_warnings=False).system.energies
        if isinstance(energy, SelfContact)
    )
    steps = simulate_scene(
        scene, prepare(scene, HybridNewton()), StopRule(60, 1e-2), initial_guess="previous", frames=frames
    )
    path = [scene.mesh.rest_positions, *(step.positions.copy() for step in steps)]
    pairs, limit = list(pairwise(path))[NUM_WARMUP_STEPS:], mesh.min_distance + mesh.dhat
    query = CollisionQuery(1.5 * limit, mesh.min_distance, MIN_GAP_FRACTION)

    def by_clusters(p: Positions, q: Positions) -> object:
        return mesh.compute_clearance_bounds(p, q, query)

    def by_boxes(p: Positions, q: Positions) -> object:
        d = q - p - (q - p).mean(axis=0)
        x, y, fast = pad_positions(p), pad_positions(p + d), float(np.linalg.norm(d, axis=1).max())
        limits = CollisionQuery(limit, mesh.min_distance, MIN_GAP_FRACTION, 2.0 * fast)
        return [certify(mesh.find_ccd_candidates(x, y, limits, edges), p, q) for edges in (False, True)]

    def certify(near: Candidates, p: Positions, q: Positions) -> tuple[float, float]:
        d = q - p - (q - p).mean(axis=0)
        free = ccd.collision_free_step_size(near, pad_positions(p), pad_positions(d), 1.0, *ccd.allocate_ccd_scratch())
        return free, float(compute_distances(near, q).min(initial=np.inf))

    def by_list(skin: float) -> float:
        """Return the time of a step [s], infinite where the skin is too small or has too many pairs."""
        at, near, began = path[0], None, thread_time()
        for p, q in pairs[:6]:
            if near is None or max(_largest_relative_displacement(at, x) for x in (p, q)) > skin:
                at, near = p, mesh.find_proximity_candidates(p, limit + skin)
                if _largest_relative_displacement(at, q) > skin or len(near.vertices) > MAX_LIST_PAIRS:
                    return np.inf
            certify(near, p, q)
        return (thread_time() - began) / len(pairs[:6])

    for work in (by_clusters, by_boxes):  # compiled
        work(*pairs[0])
    took = [[_seconds(work, p, q) for p, q in pairs] for work in (by_clusters, by_boxes)]
    best, skin = min((by_list(limit * factor), limit * factor) for factor in SKIN_FACTORS)
    clusters, boxes = np.median(took, axis=1).tolist()
    return BroadPhases(1e3 * clusters, 1e3 * boxes, 1e3 * best, skin if np.isfinite(best) else np.nan)


def _seconds(work: Callable[[Positions, Positions], object], p: Positions, q: Positions) -> float:
    began = thread_time()
    work(p, q)
    return thread_time() - began


def _largest_relative_displacement(p: Positions, q: Positions) -> float:
    d = q - p
    return 2.0 * float(np.linalg.norm(d - d.mean(axis=0), axis=1).max())


def measure_steps(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure the table `steps` and print it; a row for each ratio."""
    table = Table("scene", "a side", "solver", "step without, ms", *options.contacts, box=SIMPLE_HEAD)
    table.title = f"a step with contact that is idle over one without; {describe_machine().cpu}"
    rows = list[dict[str, Any]]()
    for cloth, size, solver in product(options.scenes, options.sizes, options.solvers):
        cells, without = list[str](), np.nan
        for name in options.contacts:
            ratio, count, without = measure_step_ratio(
                cloth, CONTACTS[name], size, solver, options.frames, options.rounds
            )
            cells.append(f"{ratio:.3f} ({count})")
            columns = {"kind": "step", "scene": cloth, "size": size, "solver": solver, "contact": name}
            rows.append(columns | {"ratio": ratio, "num_steps": count, "milliseconds": 1e3 * without})
        table.add_row(cloth, str(size), solver, f"{1e3 * without:.3g}", *cells)
    Console(width=120).print(table)
    return rows


def measure_certificates(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure the table `broad-phases` and print it; a row for each scene, size and method."""
    table = Table("scene", "a side", "clusters", "boxes", "list", "skin", box=SIMPLE_HEAD)
    table.title = f"certificate of a step with self-contact, in ms; {describe_machine().cpu}"
    rows = list[dict[str, Any]]()
    for cloth, size in product(options.scenes, options.sizes):
        found = measure_broad_phases(cloth, size, options.frames)
        table.add_row(cloth, str(size), *(f"{x:.3g}" for x in found))
        columns = {"kind": "broad-phase", "scene": cloth, "size": size, "contact": "self-contact"}
        for method in ("clusters", "boxes", "pair_list"):
            rows.append(columns | {"method": method.replace("_", " "), "milliseconds": getattr(found, method)})
    Console(width=120).print(table)
    return rows


TABLES = {"steps": measure_steps, "broad-phases": measure_certificates}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--sizes", type=int, nargs="+", default=[33, 64, 128])
    parser.add_argument("--solvers", nargs="+", default=["hybrid", "newton"])
    parser.add_argument("--scenes", nargs="+", choices=CLOTHS, default=list(CLOTHS))
    parser.add_argument("--contacts", nargs="+", choices=CONTACTS, default=list(CONTACTS))
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin = describe_provenance()
    with limit_threads(1):
        rows = [row for name in options.tables for row in TABLES[name](options)]
    config = SCENES / CLOTHS[options.scenes[0]]
    publish_rows(options.publish, config, "python -m tests.bench.idle_contact", rows, begin)


if __name__ == "__main__":
    main()
