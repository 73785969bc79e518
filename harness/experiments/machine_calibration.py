# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# SciPy's stubs are incomplete for sparse matrices.
"""Calibrate a machine by three figures, which make the times of different machines comparable.

    machine_bandwidth          bytes read and written per second when copying an array of 64 MiB
    machine_flops_per_second   additions and multiplications in a product of two matrices, 2 n^3 (BLAS, float64)
    machine_step_seconds       seconds of a fixed step: ten local-global iterations on a sheet of 32 x 32 vertices

One thread is measured in its own CPU time; the best of five repetitions counts. NumPy and SciPy do the work, so nothing
is compiled. The figures are cached for a day in the user's cache, per computer and library versions. They are not
cached if the thread had less than 95 % of the wall time, because other programs used the processor. The next process
then measures again.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import perf_counter, thread_time, time

import numpy as np
from springbench.harness.atomic_files import WriteError, atomic_write, get_user_cache_dir
from springbench.harness.execution import machine_info
from springbench.harness.execution.progress_events import ProgressCallback
from springbench.harness.execution.timing_lock import lock_timing_exclusive

CALIBRATION_COLUMNS: tuple[str, ...] = ("machine_bandwidth", "machine_flops_per_second", "machine_step_seconds")
"""Names of the columns."""

_CACHE_SECONDS = 86_400.0
_NUM_REPEATS = 5
_MIN_CPU_SHARE = 0.95
"""Smallest ratio of a thread's CPU time to wall time at which the measurement counts as undisturbed."""
_COPY_BYTES, _MATRIX_SIZE, _GRID_SIZE, _NUM_ITERATIONS = 2**26, 512, 32, 10


_CALIBRATION_CACHE: dict[str, float] = {}
"""Figures that this process has measured or loaded."""


def calibrate_machine(tick: ProgressCallback) -> dict[str, float]:
    """Return the calibration columns; empty if memory is insufficient.

    Args:
        tick: called while this waits for the timing lock.
    """
    if not _CALIBRATION_CACHE:
        with suppress(MemoryError):  # the run may limit its memory
            _CALIBRATION_CACHE.update(
                _load_or_measure(get_user_cache_dir("machine") / f"{machine_info.compute_node_id()}.json", tick)
            )
    return dict(_CALIBRATION_CACHE)


def _load_or_measure(path: Path, tick: ProgressCallback) -> dict[str, float]:
    versions = machine_info.collect_versions()
    about = [
        machine_info.describe_machine().machine_id,
        machine_info.compute_node_id(),
        versions["numpy"],
        versions["scipy"],
    ]
    with suppress(OSError, ValueError, KeyError, TypeError):
        known = json.loads(path.read_text())
        if known["about"] == about and abs(time() - known["when"]) < _CACHE_SECONDS:
            return {name: float(known[name]) for name in CALIBRATION_COLUMNS}
    with lock_timing_exclusive(tick), machine_info.limit_threads(1):
        began, used = perf_counter(), thread_time()
        found = dict(
            zip(CALIBRATION_COLUMNS, (measure_copy_bandwidth(), measure_flops(), measure_step_seconds()), strict=True)
        )
        own = (thread_time() - used) / (perf_counter() - began)
    if own < _MIN_CPU_SHARE:
        return found
    with suppress(WriteError, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as partial:
            partial.write_text(json.dumps({"about": about, "when": time(), **found}))
    return found


def measure_copy_bandwidth() -> float:
    """Measure the bandwidth of an array copy, read plus written [B/s]."""
    source = np.ones(_COPY_BYTES // 8)
    target = np.zeros_like(source)
    return 2 * _COPY_BYTES / _measure_min_cpu_seconds(lambda: np.copyto(target, source))


def measure_flops() -> float:
    """Measure the speed of a matrix product [FLOP/s]."""
    a = np.random.default_rng(0).normal(size=(_MATRIX_SIZE, _MATRIX_SIZE))
    out = np.empty_like(a)
    return 2.0 * _MATRIX_SIZE**3 / _measure_min_cpu_seconds(lambda: np.matmul(a, a, out=out))


def measure_step_seconds() -> float:
    """Measure the CPU seconds of a fixed local-global step.

    The sheet has no pins. Its rest lengths are 1, and it starts stretched by 10 %. An iteration computes
    d_e = (A p)_e / |(A p)_e|, then solves Q p = A' K d + y.
    """
    from scipy.sparse import csr_array, identity
    from scipy.sparse.linalg import splu

    number = np.arange(_GRID_SIZE**2).reshape(_GRID_SIZE, _GRID_SIZE)
    edges = np.concatenate(
        [
            np.stack([number[:-1].ravel(), number[1:].ravel()], 1),
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], 1),
        ]
    )
    count, each = len(edges), np.arange(len(edges))
    ends = np.concatenate([np.ones(count), -np.ones(count)])
    A = csr_array((ends, (np.concatenate([each, each]), edges.T.ravel())), (count, _GRID_SIZE**2))
    stiffness, inertia = 100.0, 900.0  # K [N/m] and M / dt^2, of a mass of 1 kg and a step of 1/30 s
    At = (stiffness * A.T).tocsr()
    Q = (At @ A + inertia * identity(_GRID_SIZE**2, format="csr")).tocsc()
    factor = splu(Q)
    start = (
        np.stack(
            [*np.meshgrid(np.arange(_GRID_SIZE), np.arange(_GRID_SIZE)), np.zeros((_GRID_SIZE, _GRID_SIZE))], -1
        ).reshape(-1, 3)
        * 1.1
    )
    y = inertia * (start - np.array([0.0, 0.0, 9.81 / inertia]))

    def iterate() -> None:
        p = start
        for _ in range(_NUM_ITERATIONS):
            along = A @ p
            p = factor.solve(At @ (along / np.linalg.norm(along, axis=1, keepdims=True)) + y)

    return _measure_min_cpu_seconds(iterate)


def _measure_min_cpu_seconds(work: Callable[[], object]) -> float:
    """Return the smallest CPU time of several repetitions after a warm-up [s]."""
    work()
    took = list[float]()
    for _ in range(_NUM_REPEATS):
        began = thread_time()
        work()
        took.append(thread_time() - began)
    return min(took)
