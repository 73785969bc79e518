"""cuDSS without a device: what is asked of it, by an interface that insists on what its documentation states."""

from __future__ import annotations

import gc
from enum import Enum
from itertools import islice
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csr_array, isspmatrix_csr, tril
from scipy.sparse.linalg import splu

from solvers.linear import cudss
from solvers.methods.lbfgs import Lbfgs
from solvers.methods.local_global import SparseLocalGlobal
from solvers.methods.local_global_compiled import CompiledLocalGlobal
from solvers.problem import NotPositiveDefinite, StopRule, Unsupported
from tests.effects import BEND
from tests.effects import cloth as cloth_with
from tests.scenes import cloth, first_problem, random_problem


class MatrixType(Enum):
    GENERAL, SYMMETRIC, HERMITIAN, SPD, HPD = range(5)


class MatrixViewType(Enum):
    FULL, LOWER, UPPER = range(3)


class DirectSolver:
    """As nvmath-python 1.0 documents it for a CSR matrix of SciPy and columns of NumPy, in their order: specification,
    plan, factorize, solve, free. calls: what was called, of all of them."""

    calls: list[str]

    def __init__(self, a: Any, b: NDArray[np.float64], *, options: Any) -> None:
        assert isinstance(a, csr_array) or isspmatrix_csr(a)
        assert a.indices.dtype == a.indptr.dtype == np.int32, "cuDSS takes indices of 32 bits"
        assert a.dtype == b.dtype == np.float64
        assert a.shape == (len(b), len(b))
        assert options.sparse_system_type is MatrixType.SPD
        assert options.sparse_system_view is MatrixViewType.LOWER
        assert abs(a - csr_array(tril(a))).sum() == 0.0, "the lower half is asked for"
        self._layout(b)
        self._a, self._shape, self._strides, self._b = a.copy(), b.shape, b.strides, b.copy(order="F")
        self._planned, self._factor, self._free = False, None, False
        self.calls.append("begin")

    @staticmethod
    def _layout(b: NDArray[np.float64]) -> None:
        assert b.strides[0] == b.itemsize, "columns are asked for"

    def _called(self, name: str) -> None:
        assert not self._free, f"{name} after free"
        self.calls.append(name)

    def reset_operands(self, *, b: NDArray[np.float64]) -> None:
        self._called("reset_operands")
        self._layout(b)
        assert (b.shape, b.strides, b.dtype) == (self._shape, self._strides, np.float64)
        self._b = b.copy(order="F")

    def plan(self) -> None:
        self._called("plan")
        self._planned = True

    def factorize(self) -> SimpleNamespace:
        self._called("factorize")
        assert self._planned, "factorize before plan"
        whole = csr_array(self._a + tril(self._a, -1).T)
        self._factor = splu(whole.tocsc())
        bad = np.flatnonzero(np.linalg.eigvalsh(whole.toarray())[:1] <= 0.0)
        return SimpleNamespace(info=len(bad), lu_nnz=self._factor.L.nnz)

    def solve(self) -> NDArray[np.float64]:
        self._called("solve")
        assert self._factor is not None, "solve before factorize"
        return np.asfortranarray(self._factor.solve(self._b))

    def free(self) -> None:
        self._called("free")
        self._free = True


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
    monkeypatch.setattr(cudss, "import_module", {"nvmath.sparse.advanced": advanced}.__getitem__)
    monkeypatch.setattr(cudss, "version", {"nvmath-python": "1.0.0"}.__getitem__)
    return DirectSolver.calls


@pytest.mark.parametrize("make", [lambda: first_problem(cloth(4, "exact")), lambda: random_problem(0)])
def test_iterates_are_those_of_local_global_and_q_is_factorised_once(make: Any, calls: list[str]) -> None:
    problem = make()
    wanted = [p.copy() for p in islice(SparseLocalGlobal().prepare(problem.system).iterates(problem), 5)]
    prepared = CompiledLocalGlobal(linear="cudss").prepare(problem.system)
    assert calls == ["begin", "plan", "factorize"]
    found = [p.copy() for p in islice(prepared.iterates(problem), 5)]
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10)
    assert calls[3:] == 5 * ["reset_operands", "solve"]
    assert prepared.facts["nnz_factor"] > 0
    assert prepared.choice.startswith("cudss: as asked, on a device, by nvmath-python 1.0.0")


def test_two_steps_have_one_factor_and_it_is_freed_in_the_end(calls: list[str]) -> None:
    problem = random_problem(0)
    prepared = CompiledLocalGlobal(linear="cudss").prepare(problem.system)
    for _ in range(2):
        assert prepared.solve(problem, StopRule(3)).iterations == 3
    assert [calls.count(name) for name in ("plan", "factorize", "free")] == [1, 1, 0]
    del prepared
    gc.collect()
    assert calls[-1] == "free"


def test_what_has_no_factor_is_told(calls: list[str]) -> None:
    with pytest.raises(NotPositiveDefinite, match="has no factor: it tells of row 1"):
        cudss.Cudss(csr_array(np.array([[1.0, 2.0], [2.0, 1.0]])))


def test_without_a_device_it_says_so(calls: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*given: Any, **options: Any) -> None:
        raise RuntimeError("CUDA_ERROR_NO_DEVICE: no CUDA-capable device is detected")

    monkeypatch.setattr(DirectSolver, "__init__", fails)
    with pytest.raises(Unsupported, match=r"cudss: cannot begin \(RuntimeError: CUDA_ERROR_NO_DEVICE.*'\.\[cudss\]'"):
        CompiledLocalGlobal(linear="cudss").prepare(random_problem(0).system)


def test_where_it_is_not_installed_the_command_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise cudss.PackageNotFoundError(name)

    monkeypatch.setattr(cudss, "version", missing)
    with pytest.raises(
        Unsupported, match=r"needs nvmath-python, which is not installed; `\.venv/bin/pip install -e '\.\[cudss\]'`"
    ):
        CompiledLocalGlobal(linear="cudss").prepare(random_problem(0).system)


def test_lbfgs_takes_it_too(calls: list[str]) -> None:
    problem = first_problem(cloth_with(BEND))
    found, wanted = (
        [p.copy() for p in islice(Lbfgs(linear=linear).prepare(problem.system).iterates(problem), 4)]
        for linear in ("cudss", "cholespy")
    )
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10)
    assert calls.count("factorize") == 1


def test_it_has_a_factor_in_float64_alone(calls: list[str]) -> None:
    with pytest.raises(Unsupported, match="cudss: is used in float64 alone, not in float32"):
        Lbfgs(linear="cudss", precision="float32").prepare(random_problem(0).system)
