"""Newton-CG on a device, preconditioned by additive Schwarz.

It computes the iterates of `springbench.solvers.methods.newton.newton_cg`. Positions and gradients are float64,
directions `real`: p + t d retains the digits of positions, and the next gradient corrects the error of a direction. The
host reads the numbers of each trial once. It also reads whether conjugate gradients have ended, after each
ITERATIONS_PER_CHECK of their iterations on the device. They solve H d = -g to r'z <= limit
(`springbench.solvers.linalg.krylov`):

    update_direction        p = z + r'z / (r'z before) p
    multiply_hessian        y = H p, and p'y
    evaluate_curvature      whether p'y > 0
    update_iterate          d += t p,   r -= t y
    apply_preconditioner    z = M^-1 r, and r'z
    check_convergence       whether r'z <= limit

The scalars are in `now` on the device, written by kernels of one block. After the end all kernels return at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
from springbench.solvers.cuda import cuda_device, device_sums, objective_kernels
from springbench.solvers.cuda.cuda_target import DeviceStream, LaunchGraph, cuda
from springbench.solvers.cuda.device_network import DeviceNetwork, require_known_energies
from springbench.solvers.cuda.device_schwarz import (
    DeviceAdditiveSchwarz,
    SchwarzLevel,
    UploadedLevel,
    build_levels,
    compute_schwarz_bytes,
)
from springbench.solvers.cuda.device_solver import DeviceSolverState, MinimisingSolver
from springbench.solvers.cuda.device_step import DeviceStep, LoadedStep, UploadedNetwork
from springbench.solvers.iteration.descent_method import ResidualMetric
from springbench.solvers.iteration.iterative_solver import compute_max_coordinate
from springbench.solvers.iteration.preconditioners import MIN_DIAGONAL_FRACTION, PreconditionerName
from springbench.solvers.kernels.line_search_conditions import MAX_HALVINGS, is_armijo_step
from springbench.solvers.linalg.additive_schwarz import order_into_subdomains
from springbench.solvers.model.step_problem import StepProblem, System, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective

ITERATIONS_PER_CHECK = 16
"""Iterations of conjugate gradients per check of their end."""

_NUM_SUMS = 2
"""Number of simultaneous sums."""

STATUS, NUM_ITERATIONS, RESIDUAL_PRODUCT, PREVIOUS_PRODUCT, CURVATURE, PRODUCT_LIMIT = range(6)
"""Indices of `now`: reason of the end; iterations; r'z, its previous value, p'Hp and the tolerance of r'z [J]."""

RUNNING, CONVERGED, NEGATIVE_CURVATURE = 0.0, 1.0, 2.0
"""Reasons of the end of conjugate gradients."""

Real = type[np.float32] | type[np.float64]


def prepare_newton_cg(
    system: System,
    preconditioner: PreconditionerName,
    real: Real,
    eta_bounds: tuple[float, float],
    max_cg_iterations: int,
) -> PreparedNewtonCG:
    """Prepare the method on an available device.

    Args:
        system: the system.
        preconditioner: of conjugate gradients; only schwarz is supported.
        real: floating-point type of the directions.
        eta_bounds: upper and lower bound of eta.
        max_cg_iterations: maximum number of conjugate gradient iterations.

    Raises:
        NotPositiveDefinite: if the system leaves some positions undetermined.
        Unsupported: for energies that kernels do not support, and if the device memory is too small.
    """
    if preconditioner != "schwarz":
        raise Unsupported(
            f"newton-cg, device: cuda: supports preconditioner: schwarz, not {preconditioner}; use that, or device: cpu"
        )
    require_known_energies("newton-cg", system)
    metric = ResidualMetric(system)
    order = order_into_subdomains(metric.free_block)
    network = DeviceNetwork.from_system("newton-cg", system, order)
    size = np.dtype(real).itemsize
    anchor_stiffness = (
        network.anchor_stiffness[: network.num_free] + MIN_DIAGONAL_FRACTION * metric.free_diagonal[order]
    )
    of = build_levels(network, anchor_stiffness)
    vectors = network.num_free * (3.0 * (12 * 8 + 8 * size) + 8.0 * 8)
    solve = vectors + compute_schwarz_bytes(of, size) + 4.0 * size * len(network.edge_entries.neighbour_rows)
    cuda_device.require_memory("newton-cg", network.device_bytes + solve)
    with cuda_device.guard_device_errors():
        stream = DeviceStream()
        there = [UploadedLevel.from_level(stream, level) for level in of]
        return PreparedNewtonCG(
            UploadedNetwork.from_network(network, stream),
            metric,
            FixedObjective(system),
            of,
            there,
            real,
            eta_bounds,
            max_cg_iterations,
            cuda_device.describe_device(),
            f"kernels in {np.dtype(real)}, the gradient in float64; for the residual alone {metric.description}",
        )


@dataclass(frozen=True, eq=False)
class PreparedNewtonCG(MinimisingSolver):
    """Newton-CG, prepared on a device, with the levels of the preconditioner on host and device.

    `eta_bounds` has the upper and lower bound of eta, `max_cg_iterations` is the maximum number of conjugate gradient
    iterations, and `device_columns` are the columns of the device in rows.
    """

    uploaded_network: UploadedNetwork
    metric: ResidualMetric
    objective: FixedObjective
    levels: list[SchwarzLevel]
    device_levels: list[UploadedLevel]
    real_dtype: Real
    eta_bounds: tuple[float, float]
    max_cg_iterations: int
    device_columns: dict[str, Any]
    description: str

    @property
    def stats(self) -> dict[str, float]:
        """Exact counts of the prepared data."""
        return self.metric.stats

    def allocate_state(self) -> DeviceSolverState:
        """Allocate the memory of a solve."""
        return _NewtonCGState(self)

    def residual_scale(self, problem: StepProblem) -> float:
        """Return the residual scale [J^(1/2)] for the round-off check."""
        return compute_max_coordinate(problem) * self.metric.unpinned_trace**0.5


class _NewtonCGState(DeviceSolverState):
    """State of a Newton-CG solve, in rows on the device.

    Attributes:
        _p, _q: (n, 3), current point and trial.
        _g: gradient at the current point (f, 3).
        _z: preconditioned negative gradient.
        _d, _s, _y, _w: (f, 3), solution, direction, its product and preconditioned residual of conjugate gradients.
    """

    def __init__(self, made: PreparedNewtonCG) -> None:
        of, network = made.uploaded_network, made.uploaded_network.host_network
        super().__init__(of.stream, network.row_vertices)
        self._made, stream, real, rows = made, self.stream, made.real_dtype, network.num_free
        self._begun = LoadedStep(of)
        self._edges, self._given = self._begun.device_edges, self._begun.step_data
        self._p, self._q = (stream.allocate_zeros((len(network.row_vertices), 3), np.float64) for _ in range(2))
        self._kernels, self._cg_kernels = (
            objective_kernels.build_hessian_kernels(real),
            build_conjugate_gradient_kernels(real),
        )
        self._preconditioner = DeviceAdditiveSchwarz(made.levels, made.device_levels, stream, rows, real)
        self._linear = stream.allocate_zeros((4, len(network.edge_entries.neighbour_rows)), real)
        self._g = stream.allocate_zeros((rows, 3), np.float64)
        self._z, self._d, self._s, self._y, self._w = (stream.allocate_zeros((rows, 3), real) for _ in range(5))
        self._partials, self._sums = (
            device_sums.allocate_partials(_NUM_SUMS),
            stream.allocate_zeros(_NUM_SUMS, np.float64),
        )
        self._cg_status, self._idle, self._largest = (stream.allocate_zeros(k, np.float64) for k in (6, 1, 1))
        self._over = device_sums.count_blocks(rows), device_sums.THREADS_PER_BLOCK, stream.cuda_stream
        self._over_all = (
            device_sums.count_blocks(max(rows, len(network.ends))),
            device_sums.THREADS_PER_BLOCK,
            stream.cuda_stream,
        )
        self._linearisation, self._first_cg_iterations, self._cg_iterations = (LaunchGraph(stream) for _ in range(3))
        self._max_eta, self._min_eta = made.eta_bounds
        self._floor = self._eta = self._residual_product = 0.0

    def load_step(self, step: DeviceStep) -> None:
        """Load a step; waits for the largest coordinate, which determines round-off."""
        self._begun.load_step(step, self._p, self._q)
        self.stream.overwrite_array(np.zeros(1), self._largest)
        measure_max_coordinate[self._over_all](self._p, self._largest)
        self._floor = self._made.metric.bound_energy_roundoff(float(self.stream.download_array(self._largest)[0]))
        self._eta, self._residual_product = self._max_eta, self._linearise_at_point()

    def position_rows(self) -> Any:
        """Return the current positions in rows (n, 3) [m], on the device."""
        return self._p

    def launch_iterations(self, num_iterations: int) -> int:
        """Run iterations; each waits for the numbers of its trial."""
        for number in range(num_iterations):
            if self.stalled or not self._iterate_once():
                return number
        return num_iterations

    def _iterate_once(self) -> bool:
        """Do one iteration; return False if no direction descends."""
        if not self._residual_product > self._floor or not (
            self._line_search(self._compute_direction()) or self._line_search(self._z)
        ):
            return False
        before, self._residual_product = self._residual_product, self._linearise_at_point()
        following, safeguard = 0.9 * self._residual_product / before, 0.9 * self._eta**2
        self._eta = min(self._max_eta, max(self._min_eta, following, safeguard if safeguard > 0.1 else 0.0))
        return True

    def _linearise_at_point(self) -> float:
        """Compute the gradient, the Hessian and z at p; return g'z [J]."""
        self._linearisation.launch_together(self._launch_linearisation)
        return float(self.stream.download_array(self._sums)[0])

    def _launch_linearisation(self) -> None:
        objective_kernels.write_gradient[self._over](self._edges, self._given, self._p, self._g)
        self._kernels.linearise_hessian[self._over](self._edges, len(self._g), self._p, self._linear)
        self._preconditioner.set_linearisation(self._edges, self._p)
        write_negated[self._over](self._g, self._preconditioner.r)
        self._preconditioner.apply_preconditioner(self._z, 0, self._partials, self._idle)
        self._collect_sums(1, len(self._d))

    def _collect_sums(self, count: int, terms: int) -> None:
        """Launch the second stage of the first `count` sums of `terms` terms."""
        device_sums.collect_sums[1, device_sums.THREADS_PER_BLOCK, self.stream.cuda_stream](
            count, self._partials, device_sums.count_blocks(terms), self._sums
        )

    def _line_search(self, direction: Any) -> bool:
        """Line search by step halving along a direction (f, 3); return success."""
        t, network = 1.0, self._made.uploaded_network.host_network
        for _ in range(MAX_HALVINGS):
            write_trial[self._over_all](self._p, direction, t, self._q, self._g, 0, self._partials)
            objective_kernels.sum_objective_change[self._over_all](
                self._edges, self._given, self._p, self._q, 1, self._partials
            )
            self._collect_sums(2, max(network.num_free, len(network.ends)))
            slope, rise = map(float, self.stream.download_array(self._sums))
            if not slope < 0.0:
                return False
            if is_armijo_step(rise, t, slope, 0.0):
                self.stream.copy_array(self._q, self._p)
                return True
            t *= 0.5
        return False

    def _compute_direction(self) -> Any:
        """Solve for -H^-1 g approximately by conjugate gradients."""
        limit, most = self._eta**2 * self._residual_product, self._made.max_cg_iterations
        if self._residual_product <= limit:
            return self._d
        now = np.zeros(6)
        now[RESIDUAL_PRODUCT], now[PREVIOUS_PRODUCT], now[PRODUCT_LIMIT] = self._residual_product, np.inf, limit
        self.stream.overwrite_array(now, self._cg_status)
        done = 0
        while done < most and now[STATUS] == RUNNING:
            some = min(ITERATIONS_PER_CHECK, most - done)
            launch = partial(self._launch_cg_iterations, self._w if done else self._z, some)
            if some == ITERATIONS_PER_CHECK:
                (self._cg_iterations if done else self._first_cg_iterations).launch_together(launch)
            else:
                launch()
            done += some
            now = self.stream.download_array(self._cg_status)
        return self._s if now[STATUS] == NEGATIVE_CURVATURE and now[NUM_ITERATIONS] == 0.0 else self._d

    def _launch_cg_iterations(self, z: Any, count: int) -> None:
        """Launch iterations, the first of which has the preconditioned residual z."""
        for _ in range(count):
            self._launch_cg_iteration(z)
            z = self._w

    def _launch_cg_iteration(self, z: Any) -> None:
        launch, one, count = self._over, (1, device_sums.THREADS_PER_BLOCK, self.stream.cuda_stream), self._over[0]
        self._cg_kernels.update_direction[launch](z, self._s, self._cg_status)
        self._kernels.multiply_hessian[launch](
            self._edges,
            self._given.anchor_stiffness,
            self._linear,
            self._s,
            self._y,
            0,
            self._partials,
            self._cg_status,
        )
        evaluate_curvature[one](self._partials, 0, count, self._cg_status)
        self._cg_kernels.update_iterate[launch](self._s, self._y, self._d, self._preconditioner.r, self._cg_status)
        self._preconditioner.apply_preconditioner(self._w, 1, self._partials, self._cg_status)
        check_convergence[one](self._partials, 1, count, self._cg_status)


@cuda.jit
def measure_max_coordinate(p, out):
    """Update out[0] to the largest coordinate of p.

    The maximum is independent of the order of threads.

    Args:
        p: positions (n, 3) [m].
        out: largest absolute coordinate so far (1,) [m], updated; the caller sets it to 0 first.
    """
    most, i = 0.0, cuda.grid(1)
    while i < p.shape[0]:
        for c in range(3):
            most = max(most, abs(p[i, c]))
        i += cuda.gridsize(1)
    cuda.atomic.max(out, 0, most)


@cuda.jit
def write_negated(x, out):
    """Write -x to `out`, rounded to its type.

    Args:
        x: gradient (f, 3) [N] in float64.
        out: right-hand side (f, 3) [N] in the type of the directions.
    """
    i = cuda.grid(1)
    while i < out.shape[0]:
        out[i, 0], out[i, 1], out[i, 2] = -x[i, 0], -x[i, 1], -x[i, 2]
        i += cuda.gridsize(1)


@cuda.jit
def write_trial(p, d, t, q, g, sum_slot, partials):
    """Write the trial p + t d; store the first stage of g'd.

    Args:
        p: current point in rows (n, 3) [m]; the first f rows are free.
        d: direction (f, 3) [m], in the type of the directions.
        t: step size.
        q: trial point (n, 3) [m], whose first f rows are overwritten.
        g: gradient at p (f, 3) [N].
        sum_slot: row of `partials` for the sum.
        partials: sums of the thread blocks (k, MAX_BLOCKS) [J], which a second kernel adds.
    """
    total, i = 0.0, cuda.grid(1)
    while i < d.shape[0]:
        for c in range(3):
            step = np.float64(d[i, c])
            q[i, c] = p[i, c] + t * step
            total += g[i, c] * step
        i += cuda.gridsize(1)
    device_sums.store_partial_sum(total, sum_slot, partials)


class ConjugateGradientKernels(NamedTuple):
    """Conjugate gradient kernels for one precision."""

    update_direction: Any
    update_iterate: Any


@cache
def build_conjugate_gradient_kernels(real: type[np.float32] | type[np.float64]) -> ConjugateGradientKernels:
    """Build the kernels that compute in `real`."""

    @cuda.jit
    def update_direction(z, p, now):
        """Update the direction: p = z + r'z / (r'z before) p."""
        if now[STATUS] != RUNNING:
            return
        first, scale = now[NUM_ITERATIONS] == 0.0, real(now[RESIDUAL_PRODUCT] / now[PREVIOUS_PRODUCT])
        i = cuda.grid(1)
        while i < p.shape[0]:
            for c in range(3):
                p[i, c] = z[i, c] if first else z[i, c] + scale * p[i, c]
            i += cuda.gridsize(1)

    @cuda.jit
    def update_iterate(p, y, d, r, now):
        """Update the iterate: d += t p, r -= t y."""
        if now[STATUS] != RUNNING:
            return
        first, length = now[NUM_ITERATIONS] == 0.0, real(now[RESIDUAL_PRODUCT] / now[CURVATURE])
        i = cuda.grid(1)
        while i < d.shape[0]:
            for c in range(3):
                step = length * p[i, c]
                d[i, c] = step if first else d[i, c] + step
                r[i, c] -= length * y[i, c]
            i += cuda.gridsize(1)

    return ConjugateGradientKernels(update_direction, update_iterate)


@cuda.jit
def evaluate_curvature(partials, which, count, now):
    """Second stage of p'Hp, and its sign; one block.

    Args:
        partials: sums of the blocks (k, MAX_BLOCKS) [J], from the first stage.
        which: row of `partials` with the terms of p'Hp.
        count: number of blocks of the first stage.
        now: scalars of conjugate gradients (6,); CURVATURE is written, and STATUS if p'Hp is not positive.
    """
    if now[STATUS] != RUNNING:
        return
    total = device_sums.sum_partials(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[CURVATURE] = total
        if not total > 0.0:
            now[STATUS] = NEGATIVE_CURVATURE


@cuda.jit
def check_convergence(partials, which, count, now):
    """Second stage of r'z, and the convergence test; one block.

    Args:
        partials: sums of the blocks (k, MAX_BLOCKS) [J], from the first stage.
        which: row of `partials` with the terms of r'z.
        count: number of blocks of the first stage.
        now: scalars of conjugate gradients (6,); both products and NUM_ITERATIONS are updated, and STATUS at the end.
    """
    if now[STATUS] != RUNNING:
        return
    total = device_sums.sum_partials(which, partials, count)
    if cuda.threadIdx.x == 0:
        now[PREVIOUS_PRODUCT], now[RESIDUAL_PRODUCT] = now[RESIDUAL_PRODUCT], total
        now[NUM_ITERATIONS] += 1.0
        if total <= now[PRODUCT_LIMIT]:
            now[STATUS] = CONVERGED
