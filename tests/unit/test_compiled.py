"""The compiled step: its kernels against plain NumPy, its blocks, every linear solver and precision."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import types
from numba.core.registry import cpu_target
from numba.extending import intrinsic
from springbench.solvers.kernels.spring_local_step import SpringPackets, allocate_aligned, run_local_step
from springbench.solvers.linalg.solver_selection import LinearSolverName, Precision
from springbench.solvers.methods.local_global import elimination_schedule
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.local_global.fused_local_global import PreparedCompiledLocalGlobal
from springbench.solvers.methods.local_global.reference_local_global import SparseLocalGlobal
from springbench.solvers.model.energies.spring_energy import Springs
from springbench.solvers.model.step_problem import Positions, StepProblem, StopRule
from springbench.solvers.model.system_matrix_assembly import assemble_system_matrix, energy_norm
from springbench.solvers.simd.spring_packets import PACKET_TYPE, PacketBuilder

from tests.scene_builders import (
    THREAD_COUNT,
    build_cloth,
    build_first_problem,
    build_random_network,
    build_random_problem,
)

LINEAR: tuple[LinearSolverName, ...] = ("inverse", "supernodal")
PRECISIONS: tuple[Precision, ...] = ("float64", "float32", "float16")
DIRECT = [CompiledLocalGlobal(linear, precision) for linear in LINEAR for precision in PRECISIONS]
"""The linear solvers whose panels the step goes through, in every precision."""
LESS = [solver for solver in DIRECT if solver.precision != "float64"]
ROUND_OFF = 1e-14
"""Of a sum of some dozen terms, relative to their magnitude."""


def format_label(solver: CompiledLocalGlobal) -> str:
    return f"{solver.linear_solver}, {solver.precision}"


direct = pytest.mark.parametrize("solver", DIRECT, ids=format_label)
less = pytest.mark.parametrize("solver", LESS, ids=format_label)


def iterates(prepared, problem: StepProblem, count: int) -> list[Positions]:
    return [p.copy() for p in islice(prepared.iterates(problem), count)]


def local(springs: Springs, p: Positions, y: Positions) -> Positions:
    """The local step by the kernel, over all vertices."""
    n = len(p)
    packets, _ = SpringPackets.from_springs(springs, np.arange(n), np.zeros(n, np.int64), 1, n, n + 1)
    x, b = (allocate_aligned(4 * (n + 2)) for _ in range(2))
    x[4 * (n + 1)] = 1e100
    zero = packets.build_right_hand_side(np.zeros(n + 2))
    out = np.empty_like(p)
    run_local_step(packets, p, y, x, b, zero, out)
    return out


@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-90, 1e-3, 1.0, 1e3, 1e100]))
def test_the_local_step_is_that_of_the_energy(seed, scale):
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(1, 40)), int(rng.integers(0, 200))
    _, springs = build_random_network(rng, n, m)
    p, y = scale * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    p[rng.random(n) < 0.2] = p[0]  # springs of no length among others
    expected = y.copy()
    springs.add_projection(p, expected)
    pull = np.bincount(springs.edges.ravel(), np.repeat(springs.stiffness * springs.rest_length, 2), n)
    assert (np.abs(local(springs, p, y) - expected) <= ROUND_OFF * (np.abs(y) + pull[:, None])).all()


def test_springs_have_their_weights_and_equal_ones_share_them():
    rng = np.random.default_rng(0)
    for springs in (build_random_network(rng, 30, 90)[1], build_cloth(40).all_springs):
        n = int(springs.edges.max()) + 1
        packets, _ = SpringPackets.from_springs(springs, np.arange(n), np.zeros(n, np.int64), 1, n, n + 1)
        pull, k = packets.entry_weights()
        used = packets.neighbour_offset != 4 * (n + 1)
        name = np.maximum(packets.spring_index, ~packets.spring_index)[used]
        np.testing.assert_array_equal(k[used], springs.stiffness[name])
        np.testing.assert_array_equal(pull[used], springs.stiffness[name] * springs.rest_length[name])
    assert len(packets.weights) < 0.2 * len(pull)  # a cloth's springs are of two kinds, in a few orders


def test_positions_that_are_not_numbers_stay_so_where_they_are_and_at_their_neighbours():
    rest = np.arange(12.0).reshape(4, 3)
    springs = Springs.from_rest_shape(rest, np.array([[0, 1], [1, 2], [2, 3]]), np.ones(3))
    rest[0] = np.nan
    assert np.isnan(local(springs, rest, np.zeros((4, 3)))).any(axis=1).tolist() == [True, True, False, False]


def inverse_roots(estimates: bool):
    """A compiled function (s, out) for eight numbers, from the processor's estimates or without."""

    def declare(typingctx, s, out):
        def generate(context, builder, signature, args):
            v = PacketBuilder(context, builder)
            v.has_avx512 = estimates
            s, out = (
                context.make_array(kind)(context, builder, x).data for kind, x in zip(signature.args, args, strict=True)
            )
            v.builder.store(
                v.inverse_sqrt(v.load(s, PACKET_TYPE)), builder.bitcast(out, PACKET_TYPE.as_pointer()), align=8
            )
            return context.get_dummy_value()

        return types.void(s, out), generate

    root: Any = intrinsic(declare)
    return numba.njit(lambda s, out: root(s, out))  # noqa: TID251


ESTIMATES = PacketBuilder(cpu_target.target_context, None).has_avx512


@pytest.mark.parametrize("estimates", [False, True] if ESTIMATES else [False])
def test_inverse_roots_are_right_to_the_last_digit(estimates):
    root, out = inverse_roots(estimates), np.empty(8)
    for s in 10.0 ** np.random.default_rng(0).uniform(-260, 300, (1000, 8)):
        root(s, out)
        assert np.abs(out * np.sqrt(s) - 1.0).max() <= 4 * np.finfo(float).eps  # a root, its reciprocal, a product


PROBLEMS = {
    "cloth": lambda: build_first_problem(build_cloth(8)),
    "cloth, exact pins": lambda: build_first_problem(build_cloth(8, "exact")),
    "random": lambda: build_random_problem(0, weights=(1e4, np.inf, 1e2)),
    "random, not pinned": lambda: build_random_problem(1, weights=()),
}
problems = pytest.mark.parametrize("name", PROBLEMS)


@direct
@problems
def test_every_precision_ends_where_float64_ends(solver, name):
    problem = PROBLEMS[name]()
    expected = iterates(SparseLocalGlobal().prepare(problem.system), problem, 6000)[-1]
    found = solver.prepare(problem.system).solve(problem, StopRule(6000)).positions
    # The tolerance of the method, of a scene of size one; rates of convergence leave less than 1e-11.
    assert np.abs(found - expected).max() <= 1e-9


@less
@problems
@pytest.mark.parametrize("start", [1.0, 0.0], ids=["from the guess", "from one point"])
def test_the_energy_never_rises_with_a_rounded_factor(solver, name, start):
    problem = PROBLEMS[name]()
    problem = replace(problem, initial_guess=start * problem.initial_guess)
    iterated = iterates(solver.prepare(problem.system), problem, 60)
    for before, after in pairwise(iterated):
        # A hundred terms' round-off. The rounded factor still majorises: nothing is added for it.
        assert problem.value(after) <= problem.value(before) + 1e-13 * problem.value_scale(before)
    assert problem.value(iterated[-1]) < problem.value(iterated[0])


@pytest.mark.parametrize("solver", [s for s in DIRECT if s.precision == "float64"], ids=format_label)
@problems
def test_collapsed_positions_come_apart_as_in_the_sparse_backend(solver, name):
    problem = PROBLEMS[name]()
    problem = replace(problem, initial_guess=np.zeros_like(problem.inertial_target))
    expected = iterates(SparseLocalGlobal().prepare(problem.system), problem, 1)[0]
    found = iterates(solver.prepare(problem.system), problem, 1)[0]
    assert np.abs(found - expected).max() <= 1e-10 * np.abs(expected).max()  # a solve, by the condition of Q


@pytest.mark.parametrize("solver", DIRECT[3:], ids=format_label)
@pytest.mark.parametrize("size", [3000, 30_000], ids="blocks of {} bytes".format)
def test_blocks_change_nothing_but_the_order_of_work(solver, size, monkeypatch):
    """A sheet large enough for groups, in one block each and in many, with one thread and two."""
    problem = build_first_problem(build_cloth(60))
    whole = solver.prepare(problem.system)
    monkeypatch.setattr(elimination_schedule, "MAX_BLOCK_BYTES", size)
    cut = solver.prepare(problem.system)
    assert isinstance(cut, PreparedCompiledLocalGlobal)
    assert isinstance(whole, PreparedCompiledLocalGlobal)
    assert len(cut.iteration_plan.block_table) > 10 > len(whole.iteration_plan.block_table)
    downs, ups = (
        cut.iteration_plan.visit_schedule[cut.iteration_plan.visit_schedule & 1 == side] >> 1
        for side in (elimination_schedule.VISIT_DOWN, elimination_schedule.VISIT_UP)
    )
    assert sorted(downs) == list(ups)  # the blocks of all groups, once each way
    assert (np.diff(downs) < 0).any()  # some lie above others
    expected = whole.solve(problem, StopRule(12)).positions
    found = cut.solve(problem, StopRule(12)).positions
    # Ancestors add what comes from below in another order: the last digits, of the precision that corrections have.
    assert np.abs(found - expected).max() <= {"float64": 1e-11, "float32": 1e-4, "float16": 1e-4}[solver.precision]
    np.testing.assert_array_equal(found, iterates(cut, problem, 12)[-1])


@pytest.mark.skipif(THREAD_COUNT < 2, reason="Numba was started with one thread")
@pytest.mark.parametrize("solver", DIRECT[3:], ids=format_label)
@pytest.mark.parametrize("stop", [StopRule(10), StopRule(200, 0.3)], ids=["count", "tolerance"])
def test_the_bits_do_not_depend_on_the_number_of_threads(solver, stop):
    problem = build_first_problem(build_cloth(60))
    before, found = numba.get_num_threads(), []
    try:
        for threads in (1, 2):
            numba.set_num_threads(threads)
            found.append(solver.prepare(problem.system).solve(problem, stop))
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(found[0].positions, found[1].positions)
    assert (found[0].residual, found[0].num_iterations) == (found[1].residual, found[1].num_iterations)


def test_a_small_system_uses_one_thread_and_states_it(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    small, large = (CompiledLocalGlobal().prepare(build_cloth(size).system).description for size in (12, 60))
    assert small.endswith("; 1 of 2 threads: the system is too small for a second thread to pay")
    assert "threads" not in large


@direct
@problems
def test_the_residual_is_measured_over_unpinned_vertices(solver, name):
    problem = PROBLEMS[name]()
    system = problem.system
    prepared = solver.prepare(system)
    before, after = iterates(prepared, problem, 5)[-2:]
    Q = assemble_system_matrix(system, [e for e in system.energies if isinstance(e, Springs)])
    e = np.where(system.unpinned_mask[:, None], after - before, 0.0)
    solution = prepared.solve(problem, StopRule(5))
    assert solution.residual == pytest.approx(energy_norm(Q, e), rel=1e-6)  # half the digits, or those of a correction


def test_no_iteration_is_the_first_guess():
    problem = build_random_problem(2)
    for solver in DIRECT:
        solution = solver.prepare(problem.system).solve(problem, StopRule(0))
        soft = problem.system.free_vertices
        np.testing.assert_array_equal(solution.positions[soft], problem.initial_guess[soft])
        assert solution.num_iterations == 0
        assert np.isnan(solution.residual)


def test_all_vertices_may_be_pinned_exactly():
    problem = build_random_problem(3, n=4, m=8, weights=(np.inf,) * 4)
    for solver in DIRECT:
        found = solver.prepare(problem.system).solve(problem, StopRule(3)).positions
        np.testing.assert_array_equal(found, problem.pin_targets)


def test_a_prepared_solver_states_and_counts_what_it_chose():
    system = build_first_problem(build_cloth(8)).system
    for solver in DIRECT:
        prepared = solver.prepare(system)
        assert prepared.description.startswith(solver.linear_solver)
        assert prepared.stats["factor_bytes"] > 0
        assert prepared.stats["flops_per_solve"] > 0
