# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# SciPy's and NumPy's stubs leave the types of some results unknown.
"""Compare matrices of others, in Matrix Market files, with those of a scene.

Values and explicitly stored zeros are compared.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import mmread
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import sandbox
from springbench.harness.experiments.grading.local_global_matrices import LocalGlobalMatrices

MATRIX_RTOL = 1e-6
"""Largest difference of equal entries, relative to the entry plus the median magnitude: files may have six digits."""
_LIMITS = sandbox.CallLimits(30.0, 2**31)
_NAMES = ("A", "C", "M", "Q", "y", "d", "b")


def compare_matrix_file(matrices: LocalGlobalMatrices, path: Path) -> str:
    """Compare a matrix with the one that its file is named after, such as `Q.mtx`.

    Args:
        matrices: matrices of the scene.
        path: Matrix Market file.

    Returns:
        Sentence that states whether they are equal, else a known mistake or the entry that differs most.

    Raises:
        InputError: the file cannot be read, or has another name or shape.
    """
    name = path.stem
    if name not in _NAMES or path.suffix != ".mtx":
        raise InputError(InputMistake(f"should be named {', '.join(f'{one}.mtx' for one in _NAMES)}", path))
    if not path.is_file():
        raise InputError(InputMistake("there is no such file", path))
    try:
        received: Any = sandbox.call_in_sandbox(_read_matrix, path, limits=_LIMITS)
    except sandbox.SandboxError as error:
        raise InputError(InputMistake(f"cannot be read as a Matrix Market file: {error}", path)) from None
    expected = getattr(matrices, name)
    if received.shape != expected.shape:
        raise InputError(
            InputMistake(f"has the shape {received.shape}; {name} of the scene has {expected.shape}", path)
        )
    zeros = int((received.data == 0).sum()) if isinstance(received, coo_array) else 0
    stored = f"; {zeros} stored entries are zero, which a sparse matrix leaves out" if zeros else ""
    if name in ("A", "C"):  # springs and pins may have another order, and springs another orientation
        is_equal = np.abs(_square(received) - _square(expected)).max() <= MATRIX_RTOL
        equal = f"equal to {name} of the scene, up to the order of its rows"
        return f"{path}: {equal if is_equal else f'not {name} of the scene'}{stored}"
    if name == "d" and _has_same_rows(_to_dense(received), expected):
        return f"{path}: equal to d of the scene, up to the order and the sign of its rows"
    variants = {"": expected, **_list_mistakes(matrices, name)}
    right = _to_dense(expected)
    found, nonzero = _to_dense(received), np.abs(right[right != 0.0])
    usual = float(np.median(nonzero)) if nonzero.size else 1.0  # not the largest, which is the weight of a pin
    for words, variant in variants.items():
        other = _to_dense(variant)
        if (np.abs(found - other) <= MATRIX_RTOL * (np.abs(other) + usual)).all():
            return f"{path}: {words or f'equal to {name} of the scene'}{stored}"
    away = np.abs(found - right) / (np.abs(right) + usual)
    row, column = np.unravel_index(int(np.argmax(away)), away.shape)
    words = f"{found[row, column]:.6g} instead of {right[row, column]:.6g}"
    return f"{path}: differs most at row {row}, column {column}, counted from 0: {words}{stored}"


def _list_mistakes(matrices: LocalGlobalMatrices, name: str) -> dict[str, Any]:
    """Return wrong forms of a matrix by their descriptions."""
    terms, dt, soft = matrices.terms, matrices.terms.time_step, matrices.terms.soft_mask
    pinned, weight = terms.pinned[soft], terms.weight[soft]
    if name == "Q":
        pins = np.zeros(terms.num_vertices)
        pins[pinned] = weight
        of_pins, mass = np.diag(pins), matrices.M.toarray()
        Q = matrices.Q.toarray()
        return {
            "Q without the pins, w C'C": Q - of_pins,
            "Q whose pins have the wrong sign": Q - 2.0 * of_pins,
            "Q without M/dt^2": Q - mass / dt**2,
            "Q with M instead of M/dt^2": Q - mass / dt**2 + mass,
            "Q with M/dt instead of M/dt^2": Q - mass / dt**2 + mass / dt,
            "Q without k": Q - (matrices.A.T @ ((terms.stiffness - 1.0)[:, None] * matrices.A.toarray())),
        }
    springs = matrices.b - matrices.y
    return {"b without k": matrices.y + springs / terms.stiffness[0]} if name == "b" else {}


def _read_matrix(path: Path) -> Any:
    """Read a Matrix Market file of finite numbers in the sandbox, with its stored zeros."""
    found: Any = mmread(path)
    found = found if isinstance(found, np.ndarray) else coo_array(found)
    values: Any = found if isinstance(found, np.ndarray) else found.data
    if values.dtype.kind not in "fiu":
        raise ValueError(f"it contains values of type {values.dtype}; expected real numbers")
    if not np.isfinite(values).all():
        raise ValueError("it contains numbers that are not finite")
    return found


def _square(matrix: Any) -> Any:
    """Return X'X, which the order and the sign of rows do not change."""
    x = _to_dense(matrix)
    return x.T @ x


def _has_same_rows(received: Any, expected: Any) -> bool:
    """Return whether rows (m, 3) are equal in another order and with other signs."""
    tolerance = MATRIX_RTOL * float(np.abs(expected).max(initial=0.0))
    trees = [cKDTree(np.concatenate([rows, -rows])) for rows in (received, expected) if np.isfinite(rows).all()]
    if len(trees) < 2:
        return False
    rows = np.concatenate([received, expected])
    first, second = (tree.query_ball_point(rows, tolerance, return_length=True) for tree in trees)
    return np.array_equal(first, second)


def _to_dense(matrix: Any) -> Any:
    return matrix.toarray() if isinstance(matrix, coo_array | csr_array) else np.asarray(matrix, float)
