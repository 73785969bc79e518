"""cuDSS without a device: what is asked of it, by an interface that insists on what its documentation states, with the
simulator's arrays for CuPy's."""

from __future__ import annotations

import gc
from collections.abc import Callable
from contextlib import nullcontext
from enum import Enum
from functools import partial
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array, csr_matrix, tril
from scipy.sparse.linalg import splu

from harness.simulation.measure import Settings, steps
from harness.simulation.on_device import columns
from solvers.cuda import cudss, device
from solvers.cuda.run import DeviceIterative, Stream
from solvers.methods.chebyshev import Chebyshev
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.local_global_compiled import CompiledLocalGlobal
from solvers.problem import NotPositiveDefinite, StepProblem, StopRule, Unsupported
from tests.cuda.test_steps import DRAGS, FRAMES, STOP, kept, staying, timed
from tests.cuda.test_steps import cloth as moving
from tests.cuda.test_steps import moved as moved  # a fixture
from tests.effects import BEND, DASHPOTS, LIMITS, stepped
from tests.effects import cloth as cloth_with
from tests.scenes import cloth, first_problem, random_problem

pytestmark = pytest.mark.skipif(not device.simulated(), reason="arrays of the simulator stand for CuPy's")


class MatrixType(Enum):
    GENERAL, SYMMETRIC, HERMITIAN, SPD, HPD = range(5)


class MatrixViewType(Enum):
    FULL, LOWER, UPPER = range(3)


class DirectSolver:
    """As nvmath-python 1.0 documents it for a CSR matrix and columns on a device, in their order: specification, plan,
    factorize, solve, free, all in one stream. calls: what was called, of all of them."""

    calls: list[str]

    def __init__(self, a: Any, b: NDArray[np.float64], *, options: Any, stream: int) -> None:
        assert isinstance(a, csr_matrix), "CuPy has no sparse arrays"
        assert a.indices.dtype == a.indptr.dtype == np.int32, "cuDSS takes indices of 32 bits"
        assert a.dtype == b.dtype == np.float64
        assert a.shape == (len(b), len(b))
        assert b.strides == (b.itemsize, b.itemsize * len(b)), "columns are asked for"
        assert options.sparse_system_type is MatrixType.SPD
        assert options.sparse_system_view is MatrixViewType.LOWER
        assert abs(a - tril(a)).sum() == 0.0, "the lower half is asked for"
        self._a, self._b, self._stream = a.copy(), b, stream
        self._planned, self._factor, self._free = False, None, False
        self.calls.append("begin")

    def _called(self, name: str, stream: int) -> None:
        assert not self._free, f"{name} after free"
        assert stream == self._stream
        self.calls.append(name)

    def plan(self, *, stream: int) -> None:
        self._called("plan", stream)
        self._planned = True

    def factorize(self, *, stream: int) -> SimpleNamespace:
        self._called("factorize", stream)
        assert self._planned, "factorize before plan"
        whole = csr_array(self._a + tril(self._a, -1).T)
        self._factor = splu(whole.tocsc())
        bad = np.flatnonzero(np.linalg.eigvalsh(whole.toarray())[:1] <= 0.0)
        return SimpleNamespace(info=len(bad), lu_nnz=self._factor.L.nnz)

    def solve(self, *, stream: int) -> NDArray[np.float64]:
        """Of what is in b now; a new array each time, as columns."""
        self._called("solve", stream)
        assert self._factor is not None, "solve before factorize"
        return np.asfortranarray(self._factor.solve(np.array(self._b)))

    def free(self) -> None:
        assert not self._free
        self._free = True
        self.calls.append("free")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What is called of an installed nvmath-python."""
    monkeypatch.setattr(DirectSolver, "calls", [], raising=False)
    advanced = SimpleNamespace(
        DirectSolver=DirectSolver,
        DirectSolverOptions=SimpleNamespace,
        DirectSolverMatrixType=MatrixType,
        DirectSolverMatrixViewType=MatrixViewType,
    )
    cupy = SimpleNamespace(
        asarray=lambda x: getattr(x, "_ary", x), cuda=SimpleNamespace(ExternalStream=lambda of: nullcontext())
    )
    there = {
        "nvmath.sparse.advanced": advanced,
        "cupy": cupy,
        "cupyx.scipy.sparse": SimpleNamespace(csr_matrix=csr_matrix),
    }
    monkeypatch.setattr(cudss, "import_module", there.__getitem__)
    monkeypatch.setattr(cudss, "version", {"nvmath-python": "1.0.0", "cupy-cuda12x": "14.0.0"}.__getitem__)
    return DirectSolver.calls


BY: dict[str, tuple[Callable[..., Any], str]] = {
    "numba": (CompiledLocalGlobal, "supernodal"),
    "lbfgs": (Lbfgs, "cholespy"),
}
PROBLEMS: dict[str, Callable[[], StepProblem]] = {
    "cloth, pinned exactly": lambda: first_problem(cloth(4, "exact")),
    "random": lambda: random_problem(0, weights=(1e4, np.inf, 1e2)),
    "bending and dashpots": lambda: stepped(cloth_with(BEND, DASHPOTS)),
}


def on_device(name: str, **more: Any) -> Any:
    return BY[name][0](linear="cudss", device="cuda", **more)


@pytest.mark.parametrize("make", PROBLEMS.values(), ids=list(PROBLEMS))
@pytest.mark.parametrize("name", BY)
def test_iterates_are_the_processors_and_q_is_factorised_once(
    name: str, make: Callable[[], StepProblem], calls: list[str]
) -> None:
    problem, (method, linear) = make(), BY[name]
    wanted = [p.copy() for p in islice(method(linear=linear).prepare(problem.system).iterates(problem), 4)]
    prepared = on_device(name).prepare(problem.system)
    assert calls == ["begin", "plan", "factorize"]
    found = [p.copy() for p in islice(prepared.iterates(problem), 4)]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10)
    assert set(calls[3:]) == {"solve"}
    assert prepared.choice.startswith("Q by cuDSS (nvmath-python 1.0.0, cupy 14.0.0)")
    assert prepared.facts["sweep_bytes"] > 16 * len(problem.system.free)


@pytest.mark.parametrize("name", BY)
def test_steps_stay_on_the_device_and_rows_tell_of_it(name: str, calls: list[str], moved: dict[str, list[int]]) -> None:
    made = moving(*DRAGS, moves=None)
    here = [x.positions for x in steps(made, BY[name][0]().prepare(made.system), Settings(STOP, "current", FRAMES, 1))]
    on_it = staying(made, on_device(name))
    np.testing.assert_allclose(kept(made, on_it), here, rtol=0, atol=1e-10)
    assert max(timed(on_it, moved), default=0) < made.mesh.rest.nbytes
    np.testing.assert_allclose(on_it.download(), here[-1], rtol=0, atol=1e-10)
    assert columns(on_it)["device"] == device.told()["device"]
    assert columns(on_it)["through_host"] is None


def test_two_steps_have_one_factor_and_it_is_freed_in_the_end(calls: list[str]) -> None:
    problem = random_problem(0)
    prepared = on_device("numba").prepare(problem.system)
    for _ in range(2):
        assert prepared.solve(problem, StopRule(3)).iterations == 3
    assert [calls.count(name) for name in ("plan", "factorize", "free")] == [1, 1, 0]
    del prepared
    gc.collect()
    assert calls[-1] == "free"


def test_residuals_are_of_the_iterate_that_is_returned(calls: list[str]) -> None:
    problem = first_problem(cloth(3, "exact"))
    prepared = on_device("numba").prepare(problem.system)
    assert isinstance(prepared, DeviceIterative)
    found = prepared.solve(problem, StopRule(200, 1e-3))
    assert found.stopped == "tolerance"
    truth = CompiledLocalGlobal().prepare(problem.system).residual_at(problem, found.positions)
    assert truth <= found.residual <= 1.001 * truth


def test_what_has_no_factor_is_told(calls: list[str]) -> None:
    with pytest.raises(NotPositiveDefinite, match="has no factor: it tells of row 1"):
        cudss.Cudss(csr_array(np.array([[1.0, 2.0], [2.0, 1.0]])), Stream())


def test_without_a_device_it_says_so(calls: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*given: Any, **options: Any) -> None:
        raise RuntimeError("CUDA_ERROR_NO_DEVICE: no CUDA-capable device is detected")

    monkeypatch.setattr(DirectSolver, "__init__", fails)
    with pytest.raises(
        Unsupported, match=r"cudss: cannot begin \(RuntimeError: CUDA_ERROR_NO_DEVICE.*\.\[cuda,cudss\]'"
    ):
        on_device("numba").prepare(random_problem(0).system)


def test_where_it_is_not_installed_the_command_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise cudss.PackageNotFoundError(name)

    monkeypatch.setattr(cudss, "version", missing)
    with pytest.raises(
        Unsupported,
        match=r"needs nvmath-python, which is not installed; `\.venv/bin/pip install -e '\.\[cuda,cudss\]'`",
    ):
        on_device("numba").prepare(random_problem(0).system)


@pytest.mark.parametrize(
    ("make", "solver", "named"),
    [
        (
            lambda: random_problem(0),
            partial(on_device, "lbfgs", precision="float32"),
            "cudss in float64, not factor by cudss",
        ),
        (
            lambda: random_problem(0),
            lambda: CompiledLocalGlobal(device="cuda"),
            "linear: cudss in float64 alone, not by auto",
        ),
        (
            lambda: random_problem(0),
            lambda: Chebyshev(linear="cudss"),
            "cudss: solves on a device; give `device: cuda`",
        ),
        (lambda: stepped(cloth_with(LIMITS)), partial(on_device, "numba"), "numba, device: cuda: .*StrainLimits"),
    ],
    ids=["float32", "another factor", "no device", "strain limits"],
)
def test_what_it_cannot_take_is_named(
    make: Callable[[], StepProblem], solver: Callable[[], Any], named: str, calls: list[str]
) -> None:
    with pytest.raises(Unsupported, match=named):
        solver().prepare(make().system)
