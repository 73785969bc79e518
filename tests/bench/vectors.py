"""Speedup of vector code compared with plain Numba.

    python -m tests.bench.vectors [FILE ...] [--publish results/published/vectors]

A kernel is compiled twice, as it is and with plain functions (`tests.bench.plain`) in the place of the vectors that it
calls. Both must find the same, and are then timed in turns, A B B A or B A A B by a coin, by this thread's CPU time;
the interval is the gates' (see README.md). What saves less than 15 % has no place in `solvers/simd`.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from math import ceil
from os import getloadavg
from pathlib import Path
from time import thread_time
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from numba import njit  # noqa: TID251
from scipy.sparse import csr_array
from springbench.harness.execution.machine_info import describe_machine, limit_threads
from springbench.harness.experiments.regression.abba_benchmark import MIN_CALL_SECONDS, TimedBlock, draw_block_orders
from springbench.harness.experiments.regression.confidence_sequence import compute_interval
from springbench.harness.scenes.collision_primitives import find_collision_primitives
from springbench.harness.simulation.time_loop import build_initial_state, build_problem
from springbench.solvers.contact import collisions
from springbench.solvers.contact.collision_mesh import CollisionMesh
from springbench.solvers.kernels import accelerated_descent, spring_local_step, spring_objective
from springbench.solvers.linalg.cholesky import (
    block_cholesky,
    block_multifrontal,
    factorisation_schedule,
    supernodal_cholesky,
    triangular_solve,
)
from springbench.solvers.linalg.cholesky.supernodal_cholesky import SupernodalCholesky
from springbench.solvers.linalg.multigrid import multigrid_kernels
from springbench.solvers.linalg.multigrid.multigrid_pcg import ConjugateGradients
from springbench.solvers.methods.quasi_newton import accelerated_step
from springbench.solvers.methods.vertex_block import vbd_sweeps
from springbench.solvers.model.step_problem import Positions

from tests.bench import plain
from tests.bench.gates import STOP, prepare, sheet
from tests.bench.pairs import fold_sheet
from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.bench.solves import system_matrix

SIZE, NUM_BLOCKS = 64, 40
SHEET_FILE = Path(__file__).with_name("gates.py")
"""File that states the measured sheet."""
ROUND_OFF = 1e-5
"""Of the largest entry: the same sums in another order, in float32 or among pins of 1e10 N/m in float64."""


@dataclass(frozen=True)
class Case:
    """A kernel with the arguments of a call, and what takes the place of which names in it and in what it calls.

    found: which of the arguments are outputs, in addition to what it returns; they are set back before a comparison.
    """

    what: str
    kernel: Any
    arguments: tuple[Any, ...]
    plain: dict[str, Callable[..., Any]]
    found: tuple[int, ...]


def recompile_kernel(kernel: Any, plain: dict[str, Callable[..., Any]]) -> Any:
    """The kernel, to be called from Python, with what is plain in the place of what has these names."""
    function = kernel.py_func
    names: dict[str, Any] = {}
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if name in plain and value is not None:
            names[name] = _compile_function(plain[name])
        elif isinstance(value, ModuleType) and value.__name__.startswith("springbench.solvers."):
            names[name] = ModuleType(name)
            found = {key: part for key, part in plain.items() if hasattr(value, key)}
            vars(names[name]).update(vars(value) | {key: _compile_function(part) for key, part in found.items()})
        elif (
            hasattr(value, "py_func")
            and value.__module__.startswith("springbench.solvers.")
            and _reaches(value, set(plain))
        ):
            names[name] = recompile_kernel(value, plain)
    copy = FunctionType(function.__code__, function.__globals__ | names, function.__name__, function.__defaults__)
    return _compile_function(copy)


def _compile_function(function: Callable[..., Any]) -> Any:
    options: Any = {"nogil": True, "_nrt": False}
    return njit(**options)(function)


def _reaches(kernel: Any, names: set[str], seen: frozenset[Any] = frozenset()) -> bool:
    """Whether a kernel calls what has one of these names, or calls one that does."""
    function = kernel.py_func
    called = [function.__globals__.get(name) for name in function.__code__.co_names]
    inner = [one for one in called if hasattr(one, "py_func") and one not in seen]
    return bool(names & set(function.__code__.co_names)) or any(
        _reaches(one, names, seen | {kernel}) for one in inner if one is not kernel
    )


def capture_arguments(
    module: Any, name: str, work: Callable[[], object], accepts: Callable[[tuple[Any, ...]], object] = bool
) -> tuple[Any, ...]:
    """The arguments of the last call of a kernel in a module while something is done, of those that are accepted."""
    kernel, calls = getattr(module, name), list[tuple[Any, ...]]()

    def record_call(*arguments: Any) -> Any:
        calls.append(arguments)
        return kernel(*arguments)

    record_call.overloads = defaultdict(lambda: SimpleNamespace(entry_point=record_call))  # pyright: ignore[reportFunctionMemberAccess]
    setattr(module, name, record_call)
    try:
        work()
    finally:
        setattr(module, name, kernel)
    return next(arguments for arguments in reversed(calls) if accepts(arguments))


def solving(solver: str) -> Callable[[], object]:
    """A solver's preparation and first step of the sheet of 64 x 64 vertices."""
    scene = sheet(SIZE)
    stated = build_problem(scene, build_initial_state(scene), "previous")
    return lambda: prepare(solver, scene).solve(stated, STOP)


def of_springs() -> Iterator[Case]:
    """Over bundles of eight vertices with their springs."""
    state, window, _, _ = capture_arguments(accelerated_step, "run_solve", solving("lbfgs"))
    parts, p, out = state.spring_packets, window.trial_position, window.trial_descent.copy()
    whole = 0, len(parts.packet_start) - 1
    short = {"add_spring_projection": plain.refuse, "add_spring_forces": plain.refuse}
    yield Case(
        "projections", spring_local_step.add_projection, (parts, *whole, p, state.right_hand_side, out, 0), short, (5,)
    )
    yield Case(
        "gradient", spring_local_step.add_descent, (parts, *whole, p, state.right_hand_side, out, 0), short, (5,)
    )
    displacement = np.zeros_like(p)  # longer than the direction: packets read rows of pinned vertices and padding too
    displacement[: len(window.direction)] = window.direction
    norm = (
        state.norm_packets,
        0,
        len(state.norm_packets.packet_start) - 1,
        displacement,
        state.iteration_plan.norm_diagonal,
    )
    yield Case("norm of Q", spring_local_step.squared_norm, norm, {"spring_squared_norm": plain.energy}, ())


def of_descent() -> Iterator[Case]:
    """Over the same bundles, with the objective."""
    state, window, _, _ = capture_arguments(accelerated_step, "run_solve", solving("lbfgs"))
    descent = (
        state.spring_packets,
        state.objective_weights,
        window.trial_position,
        state.right_hand_side,
        window.trial_descent.copy(),
    )
    none = {"spring_energy_and_descent": plain.refuse_energy}
    yield Case("objective and gradient", spring_objective.value_and_descent, descent, none, (4,))


def of_dots() -> Iterator[Case]:
    """Over the vectors of L-BFGS."""
    _, window, _, _ = capture_arguments(accelerated_step, "run_solve", solving("lbfgs"))
    both = {"ordered_dot": plain.dot, "ordered_dot_pair": plain.dots}
    yield Case("a step of L-BFGS", accelerated_descent.accept_trial, (window, window.correction.copy()), both, ())


def of_vbd() -> Iterator[Case]:
    """Over colours."""
    blocks, spaces, other, right, _, work, p, _ = capture_arguments(vbd_sweeps, "run_iterations", solving("vbd"))
    yield Case(
        "sweep",
        vbd_sweeps._sweep_vertices,
        (blocks, spaces, other, right, p, work),
        {"vbd_newton_step": plain.newton},
        (4,),
    )


def of_supernodal() -> Iterator[Case]:
    """Over the panels of Q's factor."""
    Q, b = system()
    panel = {"add_panel_product": plain.add_forward, "set_transposed_product": plain.set_backward}
    for precision in ("float64", "float32"):

        def solve_system(precision: Any = precision) -> None:
            SupernodalCholesky(Q, precision=precision).solve(b, np.empty_like(b))

        solve = capture_arguments(supernodal_cholesky, "solve_from_arrays", solve_system)
        yield Case(f"solve, {precision}", triangular_solve.solve_from_arrays, solve, panel, (10,))


def of_block() -> Iterator[Case]:
    """Over the fronts of a Hessian."""
    tiles = {
        "subtract_tile_product": plain.subtract_product,
        "solve_tile_triangle": plain.divide,
        "factorise_tile": plain.factorise_corner,
        "forward_solve_tile": plain.solve_columns,
        "backward_solve_tile": plain.solve_rows,
        "add_vector": plain.add,
    }
    # The call that factorises.
    arguments = capture_arguments(block_cholesky, "run_stages", solving("newton"), lambda call: len(call[2]))
    fronts, schedule, values, panels, x, *team = arguments
    yield Case("factorisation", block_multifrontal.run_stages, arguments, tiles, (3,))
    solve = fronts, factorisation_schedule.select_solve(schedule), values, panels, x, *team
    yield Case("solve", block_multifrontal.run_stages, solve, tiles, (4,))


def of_rows() -> Iterator[Case]:
    """Over sparse rows, of Q and of the levels above it."""
    Q, b = system()
    cg, rows = ConjugateGradients(Q), {"sparse_row_product": plain.gather}
    for what, name, found in (
        ("product with Q", "multiply_sparse_and_dot", (4,)),
        ("smoothing, float32", "chebyshev_step", (7, 9)),
    ):
        arguments = capture_arguments(multigrid_kernels, name, lambda: cg.solve(b, np.empty_like(b)))
        yield Case(what, getattr(multigrid_kernels, name), arguments, rows, found)


def system() -> tuple[csr_array, Positions]:
    """Q of the sheet, and a right-hand side."""
    scene = sheet(SIZE)
    return system_matrix(scene), np.random.default_rng(0).uniform(-1.0, 1.0, (scene.system.num_vertices, 3))


def of_eights() -> Iterator[Case]:
    """Over pairs of four layers that touch."""
    made = fold_sheet(SIZE)
    mesh, p = made.mesh, made.p
    surface = CollisionMesh.from_rest_shape(
        mesh.rest_positions,
        find_collision_primitives(mesh)[0],
        mesh.triangles,
        np.ones(len(p)),
        made.min_distance,
        made.dhat,
    )
    pairs = surface.find_proximity_candidates(p, 1.5 * (made.min_distance + made.dhat))
    space = collisions.allocate_collisions(len(pairs.vertices), made.min_distance, made.dhat)
    slots = np.empty(1 << (2 * len(pairs.vertices)).bit_length(), np.int32)
    arguments = pairs, collisions.pad_positions(p), np.empty((9, 8)), slots, space
    yield Case(
        "closest points of pairs",
        collisions.gather_collisions,
        arguments,
        {"compute_packet_distances": plain.eight},
        (2, 3),
    )


CASES = {
    "spring_forces": of_springs,
    "spring_descent": of_descent,
    "dot_products": of_dots,
    "vbd_packets": of_vbd,
    "panel_products": of_supernodal,
    "front_tiles": of_block,
    "sparse_rows": of_rows,
    "float64x8": of_eights,
}
"""By the file of `solvers/simd`."""


def ratio(case: Case) -> tuple[float, float, float]:
    """Plain over vectors: the median, and the interval around it. Raises AssertionError where they find otherwise."""
    assert _reaches(case.kernel, set(case.plain)), f"{case.what}: calls none of {sorted(case.plain)}"
    kernels = [recompile_kernel(case.kernel, names) for names in (case.plain, {})]
    saved, answers = [np.copy(case.arguments[k]) for k in case.found], []
    for kernel in kernels:
        for k, before in zip(case.found, saved, strict=True):
            case.arguments[k][...] = before
        returned = kernel(*case.arguments)
        answers.append([np.copy(case.arguments[k]) for k in case.found] + [returned] * isinstance(returned, float))
    for one, other in zip(*answers, strict=True):
        assert np.abs(one - other).max() <= ROUND_OFF * np.abs(other).max(), f"{case.what}: others"
    once = min(_seconds(kernel, case, 3) for kernel in kernels)
    repeats = max(1, ceil(MIN_CALL_SECONDS / once / 2))
    turns = []
    for order in islice(draw_block_orders(), NUM_BLOCKS):
        seconds = tuple(_seconds(kernels["AB".index(who)], case, repeats) for who in order)
        turns.append(TimedBlock(order, seconds).log_ratio)
    found = compute_interval(turns)
    return found.ratio, found.low, found.high


def _seconds(kernel: Any, case: Case, repeats: int) -> float:
    """How long a call takes."""
    for k in case.found:
        case.arguments[k][...] = case.arguments[k]
    began = thread_time()
    for _ in range(repeats):
        kernel(*case.arguments)
    return (thread_time() - began) / repeats


def main() -> None:
    """Measure the files that are named, or all, and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("files", nargs="*", default=list(CASES), metavar="FILE")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    print(f"{describe_machine().cpu}, one thread, {SIZE} x {SIZE} vertices; load {getloadavg()[0]:.1f}\n")
    print("| file | what | plain Numba takes | between |\n|---|---|---|---|")
    with limit_threads(1):
        for file in options.files:
            for case in CASES[file]():
                median, low, high = ratio(case)
                print(f"| `{file}` | {case.what} | {median:.2f} times as long | {low:.2f} and {high:.2f} |", flush=True)
                rows.append(
                    {"file": file, "kernel": case.what, "size": SIZE, "ratio": median, "low": low, "high": high}
                )
    command = " ".join(["python -m tests.bench.vectors", *(options.files if options.files != list(CASES) else ())])
    publish_rows(options.publish, SHEET_FILE, command, rows, begin)


if __name__ == "__main__":
    main()
