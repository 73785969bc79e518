# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# SciPy's stubs are incomplete for sparse matrices.
"""Calibrate a machine by three figures, which make the times of different machines comparable.

    machine_bandwidth   bytes read and written per second when copying an array larger than a cache
    machine_flops       additions and multiplications per second in a product of two matrices, 2 n^3 (BLAS, float64)
    machine_step        seconds of a fixed step: ten local-global iterations on a sheet of 32 x 32 vertices

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

from harness.base import machine
from harness.base.asides import Tick
from harness.base.files import CannotWrite, replacing, users_cache
from harness.base.machine_lock import alone

NAMES: tuple[str, ...] = ("machine_bandwidth", "machine_flops", "machine_step")
"""Names of the columns."""

_DAY = 86_400.0
_TRIES = 5
_OWN = 0.95
"""Smallest ratio of a thread's CPU time to wall time at which the measurement counts as undisturbed."""
_BYTES, _MATRIX, _SHEET, _ITERATIONS = 2**26, 512, 32, 10


_KNOWN: dict[str, float] = {}
"""Figures that this process has measured or loaded."""


def of_this_machine(tick: Tick) -> dict[str, float]:
    """Return the calibration columns; empty if memory is insufficient.

    Args:
        tick: called while this waits for the timing lock.
    """
    if not _KNOWN:
        with suppress(MemoryError):  # within a run's limit
            _KNOWN.update(_found(users_cache("machine") / f"{machine.node()}.json", tick))
    return dict(_KNOWN)


def _found(path: Path, tick: Tick) -> dict[str, float]:
    versions = machine.versions()
    about = [machine.describe().id, machine.node(), versions["numpy"], versions["scipy"]]
    with suppress(OSError, ValueError, KeyError, TypeError):
        known = json.loads(path.read_text())
        if known["about"] == about and abs(time() - known["when"]) < _DAY:
            return {name: float(known[name]) for name in NAMES}
    with alone(tick), machine.pinned_threads(1):
        began, used = perf_counter(), thread_time()
        found = dict(zip(NAMES, (bandwidth(), flops(), step()), strict=True))
        own = (thread_time() - used) / (perf_counter() - began)
    if own < _OWN:
        return found
    with suppress(CannotWrite, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial:
            partial.write_text(json.dumps({"about": about, "when": time(), **found}))
    return found


def bandwidth() -> float:
    """Measure the bandwidth of an array copy, read plus written [B/s]."""
    source = np.ones(_BYTES // 8)
    target = np.zeros_like(source)
    return 2 * _BYTES / _least(lambda: np.copyto(target, source))


def flops() -> float:
    """Measure the speed of a matrix product [FLOP/s]."""
    a = np.random.default_rng(0).normal(size=(_MATRIX, _MATRIX))
    out = np.empty_like(a)
    return 2.0 * _MATRIX**3 / _least(lambda: np.matmul(a, a, out=out))


def step() -> float:
    """Measure the CPU seconds of a fixed local-global step.

    The sheet hangs by one side.

    d_e = r_e (A p)_e / |(A p)_e|, then Q p = A' K d + y.
    """
    from scipy.sparse import csr_array, identity
    from scipy.sparse.linalg import splu

    number = np.arange(_SHEET**2).reshape(_SHEET, _SHEET)
    edges = np.concatenate(
        [
            np.stack([number[:-1].ravel(), number[1:].ravel()], 1),
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], 1),
        ]
    )
    count, each = len(edges), np.arange(len(edges))
    ends = np.concatenate([np.ones(count), -np.ones(count)])
    A = csr_array((ends, (np.concatenate([each, each]), edges.T.ravel())), (count, _SHEET**2))
    stiffness, inertia = 100.0, 900.0  # K [N/m] and M / dt^2, of a mass of 1 kg and a step of 1/30 s
    At = (stiffness * A.T).tocsr()
    Q = (At @ A + inertia * identity(_SHEET**2, format="csr")).tocsc()
    factor = splu(Q)
    start = (
        np.stack([*np.meshgrid(np.arange(_SHEET), np.arange(_SHEET)), np.zeros((_SHEET, _SHEET))], -1).reshape(-1, 3)
        * 1.1
    )
    y = inertia * (start - np.array([0.0, 0.0, 9.81 / inertia]))

    def iterate() -> None:
        p = start
        for _ in range(_ITERATIONS):
            along = A @ p
            p = factor.solve(At @ (along / np.linalg.norm(along, axis=1, keepdims=True)) + y)

    return _least(iterate)


def _least(work: Callable[[], object]) -> float:
    """Return the smallest CPU time of several repetitions after a warm-up [s]."""
    work()
    took = list[float]()
    for _ in range(_TRIES):
        began = thread_time()
        work()
        took.append(thread_time() - began)
    return min(took)
