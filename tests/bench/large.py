"""Measure processor time, memory and residual of the runs of a sweep with large meshes, once each.

    python -m tests.bench.large [CONFIG] [--only WORDS ...] [--sizes SIZE ...]
        [--publish results/published/growth-large]
    python -m tests.bench.large configs/contact.yaml --last-step --threads 2

The default of CONFIG is `configs/growth-large.yaml`. WORDS select runs whose title contains them: scene, size, solver
and initial guess in this order, as in "flag-in-wind 122". Each run is executed in a separate process, whose peak memory
includes the reference evaluator. Preparation and steps are timed separately; one warm-up iteration precedes the steps.
The time of a step is the mean over the frames, or with `--last-step` the time of the last frame, for example of the
third frame in contact. The residual is the largest |Q^-1 grad g|_Q over the frames, relative to that at the frame's
current positions. `growth` is the exponent of the number of vertices in the processor time of a step, relative to the
smallest mesh of the same solver.
"""

from __future__ import annotations

import argparse
import resource
from concurrent.futures import ProcessPoolExecutor
from math import log
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, NamedTuple

from springbench.harness.config.config_loader import load_sweep
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.reference.reference_evaluator import ReferenceEvaluator
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.simulation.auto_tolerance import build_stop_rule
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
from springbench.solvers.model.step_problem import StopRule
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

GROWTH = Path(__file__).parents[2] / "configs" / "growth-large.yaml"


class Cost(NamedTuple):
    """Cost of a run.

    prepare_seconds, cpu_seconds: processor time of the preparation and of a step [s]; seconds: wall time of a step [s];
    num_iterations: of a step; residual: largest relative one; peak_gib: peak memory [GiB].
    """

    vertices: int
    prepare_seconds: float
    cpu_seconds: float
    seconds: float
    num_iterations: float
    residual: float
    peak_gib: float


def measure_run(run: RunSpec, threads: int, first_frame: int) -> Cost:
    """Execute a run with a number of threads, and measure its cost; the evaluation of residuals is not timed.

    The steps before the frame `first_frame` are computed, but not measured.
    """
    with limit_threads(threads):
        scene = build_scene(run.scene, run.size, run.integrator)
        stop = build_stop_rule(run.max_iterations, run.rtol)
        assert isinstance(stop, StopRule), "a tolerance by the step error has no initial residual"
        began = process_time()
        prepared = prepare(scene, load_target(SOLVERS[str(run.solver.name)])(**run.solver.parameters))
        prepare_seconds = process_time() - began
        first = build_problem(scene, build_initial_state(scene), run.initial_guess)
        prepared.solve(first, StopRule(1, stop.rtol))
        evaluator, cpu, wall, iterations, residual = ReferenceEvaluator(scene.system), 0.0, 0.0, 0, 0.0
        steps = simulate_scene(scene, prepared, stop, initial_guess=run.initial_guess, frames=run.frames)
        for frame in range(run.frames):
            began, then = process_time(), perf_counter()
            done = next(steps)
            if frame < first_frame:
                continue
            cpu, wall = cpu + process_time() - began, wall + perf_counter() - then
            iterations += done.num_iterations
            last = evaluator.compute_residual(done.problem, done.solution.positions)
            residual = max(residual, last / evaluator.compute_initial_residual(done.problem))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    frames = run.frames - first_frame
    per_frame = cpu / frames, wall / frames, iterations / frames
    return Cost(len(scene.mesh.rest_positions), prepare_seconds, *per_frame, residual, peak)


def main() -> None:
    """Print a line for each run when it ends."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("config", nargs="?", type=Path, default=GROWTH, metavar="CONFIG")
    parser.add_argument(
        "--only", nargs="*", default=[""], metavar="WORDS", help="runs whose title contains one of these"
    )
    parser.add_argument("--sizes", nargs="*", type=int, help="mesh sizes; all by default")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--last-step", action="store_true", help="measure the last frame alone")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    smallest: dict[tuple[str, str, str], Cost] = {}
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    print("run | vertices | prepare s | step s | wall s | iterations | residual | peak GiB | growth")
    for run in load_sweep(options.config).list_runs():
        title = f"{run.title} {run.initial_guess}"
        if not any(words in title for words in options.only) or run.size not in (options.sizes or [run.size]):
            continue
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            first = run.frames - 1 if options.last_step else 0
            cost = pool.submit(measure_run, run, options.threads, first).result()
        columns = {"scene": run.scene_name, "size": run.size, "solver": run.solver.name}
        rows.append(columns | {"initial_guess": run.initial_guess} | cost._asdict())
        base = smallest.setdefault((run.scene_name, run.solver.name, run.initial_guess), cost)
        ratio = cost.cpu_seconds / base.cpu_seconds
        growth = f"{log(ratio) / log(cost.vertices / base.vertices):.2f}" if base is not cost else ""
        line = f"{title} | {cost.vertices:,} | {cost.prepare_seconds:.2f} | {cost.cpu_seconds:.3g} | {cost.seconds:.3g}"
        print(f"{line} | {cost.num_iterations:.1f} | {cost.residual:.2e} | {cost.peak_gib:.2f} | {growth}", flush=True)
    publish_rows(options.publish, options.config, rows, begin)


if __name__ == "__main__":
    main()
