"""Measure the overhead of idle contact: steps of cloth with contact but without active pairs, over steps without.

    python -m tests.bench.idle_contact [--tables steps broad-phases] [--sizes 33 64 128] [--solvers hybrid newton]
        [--scenes cloth flag] [--publish results/published/idle-contact]

steps           The swinging cloth and the flag are simulated to a relative residual of 1e-6: with self-contact, with
                surface contact to a plane 5 m below, and without contact. The simulations with and without contact
                alternate step by step on one thread, in several rounds. The ratio is that of the processor times of
                all steps after the first two, up to the first in which contact acts. The time of a step is the least
                of the rounds.
broad-phases    Three methods certify that a step with self-contact is free of collisions and ends without active pairs:
                affine clusters, the bounding volume hierarchy, and a neighbour list with a skin. The list is built
                again when the bound of relative displacements of vertices exceeds the skin. The result of the list is
                that of the fastest of several skins.
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
"""Skins of neighbour lists, as multiples of the minimum plus the activation distance; and their largest size."""


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
    """Processor time [ms] of a step's certificate by method; skin [m] of the list, nan if none is sufficient."""

    clusters: float
    boxes: float
    pair_list: float
    skin: float


def measure_broad_phases(cloth: str, size: int, frames: int) -> BroadPhases:
    """Measure the certificates for the steps of a motion without contact."""
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
    trajectory = [scene.mesh.rest_positions, *(step.positions.copy() for step in steps)]
    step_ends, limit = list(pairwise(trajectory))[NUM_WARMUP_STEPS:], mesh.min_distance + mesh.dhat
    query = CollisionQuery(1.5 * limit, mesh.min_distance, MIN_GAP_FRACTION)

    def certify_by_clusters(p: Positions, q: Positions) -> object:
        return mesh.compute_clearance_bounds(p, q, query)

    def certify_by_boxes(p: Positions, q: Positions) -> object:
        d = q - p - (q - p).mean(axis=0)
        x, y, max_length = pad_positions(p), pad_positions(p + d), float(np.linalg.norm(d, axis=1).max())
        box_query = CollisionQuery(limit, mesh.min_distance, MIN_GAP_FRACTION, 2.0 * max_length)
        return [certify(mesh.find_ccd_candidates(x, y, box_query, edges), p, q) for edges in (False, True)]

    def certify(candidates: Candidates, p: Positions, q: Positions) -> tuple[float, float]:
        """Return the collision-free step size and the least distance at q [m]."""
        d, scratch = q - p - (q - p).mean(axis=0), ccd.allocate_ccd_scratch()
        step_size = ccd.collision_free_step_size(candidates, pad_positions(p), pad_positions(d), 1.0, *scratch)
        return step_size, float(compute_distances(candidates, q).min(initial=np.inf))

    def measure_list(skin: float) -> float:
        """Return the processor time of a step [s], infinite if the skin is too small or contains too many pairs."""
        built_at, candidates, began = trajectory[0], None, thread_time()
        for p, q in step_ends[:6]:
            if candidates is None or max(_bound_relative_displacement(built_at, x) for x in (p, q)) > skin:
                built_at, candidates = p, mesh.find_proximity_candidates(p, limit + skin)
                if _bound_relative_displacement(built_at, q) > skin or len(candidates.vertices) > MAX_LIST_PAIRS:
                    return np.inf
            certify(candidates, p, q)
        return (thread_time() - began) / len(step_ends[:6])

    methods = certify_by_clusters, certify_by_boxes
    for certify_step in methods:  # compiles
        certify_step(*step_ends[0])
    times = [[_measure_seconds(certify_step, p, q) for p, q in step_ends] for certify_step in methods]
    best, skin = min((measure_list(limit * factor), limit * factor) for factor in SKIN_FACTORS)
    clusters, boxes = np.median(times, axis=1).tolist()
    return BroadPhases(1e3 * clusters, 1e3 * boxes, 1e3 * best, skin if np.isfinite(best) else np.nan)


def _measure_seconds(work: Callable[[Positions, Positions], object], p: Positions, q: Positions) -> float:
    began = thread_time()
    work(p, q)
    return thread_time() - began


def _bound_relative_displacement(p: Positions, q: Positions) -> float:
    """Return an upper bound [m] of the displacement of two vertices relative to each other, from p to q."""
    d = q - p
    return 2.0 * float(np.linalg.norm(d - d.mean(axis=0), axis=1).max())


def measure_steps(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Measure the table `steps`, print it, and return a row for each ratio."""
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
    """Measure the table `broad-phases`, print it, and return a row for each scene, size and method."""
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
    publish_rows(options.publish, config, rows, begin)


if __name__ == "__main__":
    main()
