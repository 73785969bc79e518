"""Measure the speedup of vector code compared with plain Numba.

    python -m tests.bench.vectors [FILE ...] [--publish results/published/vectors]

A kernel is compiled twice: as it is, and with plain functions (`tests.bench.plain`) in place of the vector functions
that it calls. Both must compute the same results. They are then timed interleaved in blocks of random order, A B B A or
B A A B, by the CPU time of the thread. The ratio is plain over vector code; its interval is computed as for the gates
(see README.md). Vector code that saves less than 15 % does not belong in `solvers/simd`.
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
from springbench.solvers.iteration.saddle_check import SaddleCheck
from springbench.solvers.kernels import (
    accelerated_descent,
    curvature_search,
    hessian_packets,
    spring_local_step,
    spring_objective,
)
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
from springbench.solvers.objective.fixed_objective import FixedObjective

from tests.bench import plain
from tests.bench.factor_threads import build_newton_iteration
from tests.bench.gates import STOP, build_sheet, prepare_solver
from tests.bench.pairs import fold_sheet
from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.bench.solves import build_system_matrix

SIZE, NUM_BLOCKS = 64, 40
SHEET_FILE = Path(__file__).with_name("gates.py")
"""File that defines the measured sheet."""
ROUND_OFF = 1e-5
"""Accepted difference over the largest entry: sums in another order, in float32 or with pins of 1e10 N/m in float64."""


@dataclass(frozen=True)
class KernelCase:
    """A kernel with the arguments of a call, and the plain functions that replace vector functions.

    plain_functions: by the names that they replace in the kernel and in its callees; outputs: indices of arguments that
    are outputs, in addition to the returned value; they are restored before a comparison.
    """

    name: str
    kernel: Any
    arguments: tuple[Any, ...]
    plain_functions: dict[str, Callable[..., Any]]
    outputs: tuple[int, ...]


def recompile_kernel(kernel: Any, plain_functions: dict[str, Callable[..., Any]]) -> Any:
    """Compile a kernel for calls from Python, with plain functions in place of those with these names."""
    function = kernel.py_func
    names: dict[str, Any] = {}
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        if name in plain_functions and value is not None:
            names[name] = _compile_function(plain_functions[name])
        elif isinstance(value, ModuleType) and value.__name__.startswith("springbench.solvers."):
            names[name] = ModuleType(name)
            replaced = {key: part for key, part in plain_functions.items() if hasattr(value, key)}
            vars(names[name]).update(vars(value) | {key: _compile_function(part) for key, part in replaced.items()})
        elif (
            hasattr(value, "py_func")
            and value.__module__.startswith("springbench.solvers.")
            and _calls_any(value, set(plain_functions))
        ):
            names[name] = recompile_kernel(value, plain_functions)
    copy = FunctionType(function.__code__, function.__globals__ | names, function.__name__, function.__defaults__)
    return _compile_function(copy)


def _compile_function(function: Callable[..., Any]) -> Any:
    options: Any = {"nogil": True, "_nrt": False}
    return njit(**options)(function)


def _calls_any(kernel: Any, names: set[str], seen: frozenset[Any] = frozenset()) -> bool:
    """Return whether a kernel calls a function with one of these names, directly or through its callees."""
    function = kernel.py_func
    called = [function.__globals__.get(name) for name in function.__code__.co_names]
    inner = [one for one in called if hasattr(one, "py_func") and one not in seen]
    return bool(names & set(function.__code__.co_names)) or any(
        _calls_any(one, names, seen | {kernel}) for one in inner if one is not kernel
    )


def capture_arguments(
    module: Any, name: str, work: Callable[[], object], accepts: Callable[[tuple[Any, ...]], object] = bool
) -> tuple[Any, ...]:
    """Return the arguments of the last accepted call of a module's kernel during some work."""
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


def build_solve(solver: str) -> Callable[[], object]:
    """Return a function that prepares a solver, and solves the first step of the sheet of 64 x 64 vertices."""
    scene = build_sheet(SIZE)
    problem = build_problem(scene, build_initial_state(scene), "previous")
    return lambda: prepare_solver(solver, scene).solve(problem, STOP)


def build_spring_cases() -> Iterator[KernelCase]:
    """Yield kernels on packets of eight vertices with their springs."""
    state, window, _, _ = capture_arguments(accelerated_step, "run_solve", build_solve("lbfgs"))
    packets, p, out = state.spring_packets, window.trial_position, window.trial_descent.copy()
    arguments = packets, 0, len(packets.packet_start) - 1, p, state.right_hand_side, out, 0
    rejecting = {"add_spring_projection": plain.reject_packet, "add_spring_forces": plain.reject_packet}
    yield KernelCase("projections", spring_local_step.add_projection, arguments, rejecting, (5,))
    yield KernelCase("gradient", spring_local_step.add_descent, arguments, rejecting, (5,))
    displacement = np.zeros_like(p)  # includes rows of pinned vertices and padding, which packets read
    displacement[: len(window.direction)] = window.direction
    norm = (
        state.norm_packets,
        0,
        len(state.norm_packets.packet_start) - 1,
        displacement,
        state.iteration_plan.norm_diagonal,
    )
    squared_norm = {"spring_squared_norm": plain.compute_squared_norm}
    yield KernelCase("norm of Q", spring_local_step.squared_norm, norm, squared_norm, ())


def build_descent_cases() -> Iterator[KernelCase]:
    """Yield the kernel of the objective and its gradient, on packets of eight vertices with their springs."""
    state, window, _, _ = capture_arguments(accelerated_step, "run_solve", build_solve("lbfgs"))
    descent = (
        state.spring_packets,
        state.objective_weights,
        window.trial_position,
        state.right_hand_side,
        window.trial_descent.copy(),
    )
    rejecting = {"spring_energy_and_descent": plain.reject_energy}
    yield KernelCase("objective and gradient", spring_objective.value_and_descent, descent, rejecting, (4,))


def build_product_cases() -> Iterator[KernelCase]:
    """Yield the kernel of products with the Hessian, on packets of eight vertices with their springs."""
    scene = build_sheet(SIZE)
    problem = build_problem(scene, build_initial_state(scene), "previous")
    check = SaddleCheck(FixedObjective(scene.system))
    pressed = 0.9 * scene.mesh.rest_positions

    def search() -> object:
        return check.find_negative_curvature(problem, pressed, 1)

    *_, packets, _, scratch = capture_arguments(curvature_search, "search_compiled", search)
    arguments = packets, scratch.direction, scratch.product
    product = {"write_spring_products": plain.multiply_springs}
    yield KernelCase("product with the Hessian", hessian_packets.multiply_packets, arguments, product, (2,))


def build_dot_cases() -> Iterator[KernelCase]:
    """Yield the kernel of dot products of the vectors of L-BFGS."""
    _, window, _, _ = capture_arguments(accelerated_step, "run_solve", build_solve("lbfgs"))
    dots, arguments = {"ordered_dot": plain.dot, "ordered_dot_pair": plain.dot_pair}, (window, window.correction.copy())
    yield KernelCase("a step of L-BFGS", accelerated_descent.accept_trial, arguments, dots, ())


def build_vbd_cases() -> Iterator[KernelCase]:
    """Yield the kernel of sweeps over vertices by colour."""
    blocks, spaces, other, right, _, work, p, _ = capture_arguments(vbd_sweeps, "run_iterations", build_solve("vbd"))
    arguments, newton_step = (blocks, spaces, other, right, p, work), {"vbd_newton_step": plain.step_vertices}
    yield KernelCase("sweep", vbd_sweeps._sweep_vertices, arguments, newton_step, (4,))


def build_supernodal_cases() -> Iterator[KernelCase]:
    """Yield kernels of solves with the supernodal factor of Q, by precision."""
    Q, b = build_system()
    panel = {"add_panel_product": plain.add_panel_product, "set_transposed_product": plain.set_transposed_product}
    for precision in ("float64", "float32"):

        def solve_system(precision: Any = precision) -> None:
            SupernodalCholesky(Q, precision=precision).solve(b, np.empty_like(b))

        solve = capture_arguments(supernodal_cholesky, "solve_from_arrays", solve_system)
        yield KernelCase(f"solve, {precision}", triangular_solve.solve_from_arrays, solve, panel, (10,))


def build_block_cases() -> Iterator[KernelCase]:
    """Yield kernels of the factorisation and the solve on the fronts of a Hessian."""
    tiles = {
        "subtract_tile_product": plain.subtract_tile_product,
        "solve_tile_triangle": plain.solve_tile_triangle,
        "factorise_tile": plain.factorise_tile,
        "forward_solve_tile": plain.forward_solve_tile,
        "backward_solve_tile": plain.backward_solve_tile,
        "add_vector": plain.add_vector,
    }
    iterate, *_ = build_newton_iteration(SIZE)
    arguments = capture_arguments(block_cholesky, "run_stages", iterate, lambda call: len(call[2]))  # has matrix values
    fronts, schedule, values, panels, x, *team = arguments
    yield KernelCase("factorisation", block_multifrontal.run_stages, arguments, tiles, (3,))
    solve = fronts, factorisation_schedule.select_solve(schedule), values, panels, x, *team
    yield KernelCase("solve", block_multifrontal.run_stages, solve, tiles, (4,))


def build_row_cases() -> Iterator[KernelCase]:
    """Yield kernels on sparse rows of Q, and of the coarser levels of its multigrid hierarchy."""
    Q, b = build_system()
    cg, rows = ConjugateGradients(Q), {"sparse_row_product": plain.multiply_sparse_row}
    for title, name, outputs in (
        ("product with Q", "multiply_sparse_and_dot", (4,)),
        ("smoothing, float32", "chebyshev_step", (7, 9)),
    ):
        arguments = capture_arguments(multigrid_kernels, name, lambda: cg.solve(b, np.empty_like(b)))
        yield KernelCase(title, getattr(multigrid_kernels, name), arguments, rows, outputs)


def build_system() -> tuple[csr_array, Positions]:
    """Return the matrix Q of the sheet, and a right-hand side (n, 3)."""
    scene = build_sheet(SIZE)
    return build_system_matrix(scene), np.random.default_rng(0).uniform(-1.0, 1.0, (scene.system.num_vertices, 3))


def build_distance_cases() -> Iterator[KernelCase]:
    """Yield the kernel of distances of candidate pairs, of four layers that touch."""
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
    storage = collisions.allocate_collisions(len(pairs.vertices), made.min_distance, made.dhat)
    slots = np.empty(1 << (2 * len(pairs.vertices)).bit_length(), np.int32)
    arguments = pairs, collisions.pad_positions(p), np.empty((9, 8)), slots, storage
    distances = {"compute_packet_distances": plain.compute_packet_distances}
    yield KernelCase("closest points of pairs", collisions.gather_collisions, arguments, distances, (2, 3))


CASES = {
    "spring_forces": build_spring_cases,
    "spring_descent": build_descent_cases,
    "spring_products": build_product_cases,
    "dot_products": build_dot_cases,
    "vbd_packets": build_vbd_cases,
    "panel_products": build_supernodal_cases,
    "front_tiles": build_block_cases,
    "sparse_rows": build_row_cases,
    "float64x8": build_distance_cases,
}
"""Functions that yield the kernels of each file of vector code, by the name of the file."""


def measure_ratio(case: KernelCase) -> tuple[float, float, float]:
    """Return the median time ratio of plain to vector code, and its interval.

    Raises AssertionError if the results differ.
    """
    replaced = sorted(case.plain_functions)
    assert _calls_any(case.kernel, set(replaced)), f"{case.name}: calls none of {replaced}"
    kernels = [recompile_kernel(case.kernel, functions) for functions in (case.plain_functions, {})]
    saved, results = [np.copy(case.arguments[k]) for k in case.outputs], []
    for kernel in kernels:
        for k, before in zip(case.outputs, saved, strict=True):
            case.arguments[k][...] = before
        returned = kernel(*case.arguments)
        results.append([np.copy(case.arguments[k]) for k in case.outputs] + [returned] * isinstance(returned, float))
    for one, other in zip(*results, strict=True):
        assert np.abs(one - other).max() <= ROUND_OFF * np.abs(other).max(), f"{case.name}: results differ"
    once = min(_measure_seconds(kernel, case, 3) for kernel in kernels)
    repeats = max(1, ceil(MIN_CALL_SECONDS / once / 2))
    log_ratios = []
    for order in islice(draw_block_orders(), NUM_BLOCKS):
        seconds = tuple(_measure_seconds(kernels["AB".index(program)], case, repeats) for program in order)
        log_ratios.append(TimedBlock(order, seconds).log_ratio)
    interval = compute_interval(log_ratios)
    return interval.ratio, interval.low, interval.high


def _measure_seconds(kernel: Any, case: KernelCase, repeats: int) -> float:
    """Return the mean CPU time [s] of a call; later calls start from the outputs of earlier ones."""
    began = thread_time()
    for _ in range(repeats):
        kernel(*case.arguments)
    return (thread_time() - began) / repeats


def main() -> None:
    """Measure the files of the command line, or all, and print a table."""
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
                median, low, high = measure_ratio(case)
                print(f"| `{file}` | {case.name} | {median:.2f} times as long | {low:.2f} and {high:.2f} |", flush=True)
                rows.append(
                    {"file": file, "kernel": case.name, "size": SIZE, "ratio": median, "low": low, "high": high}
                )
    publish_rows(options.publish, SHEET_FILE, rows, begin)


if __name__ == "__main__":
    main()
