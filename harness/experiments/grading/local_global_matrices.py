# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# SciPy's and NumPy's stubs leave the types of some results unknown.
"""The matrices and vectors of one local-global iteration, named as in the assignment.

    Q = A'KA + M/dt^2 + w C'C
    y = M (2 p^t - p^(t-dt))/dt^2 + f_ext + w C'C p_rest
    d_e = r_e (A p)_e / |(A p)_e|
    b = A'K d + y,   Q p = b

Liu et al. 2013, section 4.1. Exact pins contribute to neither Q nor y; their rows and columns are deleted.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import mmwrite
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu
from springbench.harness.atomic_files import atomic_write
from springbench.harness.experiments.grading.spring_terms import (
    SpringTerms,
    build_step_problem,
    collect_spring_terms,
    compute_position_before_start,
)
from springbench.harness.scenes.assignment_scene import ASSIGNMENT_ITERATIONS
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state
from springbench.solvers.model import system_matrix_assembly
from springbench.solvers.model.step_problem import Positions, StepProblem

_SHOWN_ROWS, _SHOWN_COLUMNS = 12, 12
"""Largest part of a matrix that is printed."""


class LocalGlobalMatrices(NamedTuple):
    """Matrices and vectors of one iteration.

    Attributes:
        E: springs (m, 2), vertex pairs.
        A: signed incidence (m, n).
        C: selection of the pins (q, n).
        M: masses (n, n) [kg].
        Q: system matrix (n, n) [N/m].
        k: stiffnesses (m,) [N/m].
        r: rest lengths (m,) [m].
        p: positions (n, 3) [m] at which d is evaluated.
        y: constant part of the right-hand side (n, 3) [N].
        d: directions times rest lengths (m, 3) [m].
        b: right-hand side (n, 3) [N].
        terms: the terms of the scene.
    """

    E: NDArray[np.int64]
    A: csr_array
    C: csr_array
    M: csr_array
    Q: csr_array
    k: NDArray[np.float64]
    r: NDArray[np.float64]
    p: Positions
    y: Positions
    d: Positions
    b: Positions
    terms: SpringTerms

    @property
    def sparse_matrices(self) -> dict[str, csr_array]:
        """The sparse matrices by name."""
        return {"A": self.A, "C": self.C, "M": self.M, "Q": self.Q}

    @property
    def dense_arrays(self) -> dict[str, NDArray[Any]]:
        """The dense arrays by name."""
        return {name: getattr(self, name) for name in ("E", "k", "r", "p", "y", "d", "b")}


def build_local_global_matrices(scene: Scene, frame: int = 1, initial_guess: str = "assignment") -> LocalGlobalMatrices:
    """Build the matrices of the first iteration of a step.

    Args:
        scene: scene of springs, masses, forces and pins.
        frame: number of the step; earlier ones have ASSIGNMENT_ITERATIONS iterations each.
        initial_guess: positions at which the step starts, a key of `INITIAL_GUESSES`.

    Raises:
        InputError: the scene has other terms.
    """
    terms = collect_spring_terms(scene)
    Q = terms.build_system_matrix()
    current, previous = build_initial_state(scene).motion.positions, compute_position_before_start(scene)
    problem = build_step_problem(scene, current, previous, 0, initial_guess)
    for index in range(1, frame):
        current, previous = iterate_local_global(terms, Q, problem, ASSIGNMENT_ITERATIONS), current
        problem = build_step_problem(scene, current, previous, index, initial_guess)
    A, p, y = terms.build_incidence(), problem.initial_guess, compute_constant_side(terms, problem)
    d = terms.project_springs(p)
    M = system_matrix_assembly.mass_matrix_sparse(terms.mass)
    b = A.T @ (terms.stiffness[:, None] * d) + y
    C, k, r = terms.build_selection(), terms.stiffness, terms.rest_length
    return LocalGlobalMatrices(terms.edges, A, C, M, Q, k, r, p, y, d, b, terms)


def compute_constant_side(terms: SpringTerms, problem: StepProblem) -> Positions:
    """Compute y (n, 3) [N] of a step.

    Args:
        terms: terms of the scene; of the pins, only penalties contribute.
        problem: step problem with the inertial target and the external force.
    """
    y = problem.system.inertia_diagonal[:, None] * problem.inertial_target + problem.external_force
    soft = terms.soft_mask
    y[terms.pinned[soft]] += terms.weight[soft, None] * problem.pin_targets[soft]
    return y


def iterate_local_global(terms: SpringTerms, Q: csr_array, problem: StepProblem, iterations: int) -> Positions:
    """Return the positions p (n, 3) [m] after some local-global iterations.

    An iteration evaluates d at p and solves Q p = A'K d + y.

    Args:
        terms: terms of the scene; exactly pinned vertices have the current positions of the problem, their targets.
        Q: system matrix (n, n) [N/m].
        problem: step problem, whose initial guess is the first iterate.
        iterations: number of iterations.
    """
    free, p, y = terms.free_vertices, problem.initial_guess.copy(), compute_constant_side(terms, problem)
    fixed = np.setdiff1d(np.arange(len(p)), free)
    p[fixed] = problem.current_positions[fixed]
    A, rows = terms.build_incidence(), Q[free]
    factor = splu(rows[:, free].tocsc())
    known = y[free] - rows[:, fixed] @ p[fixed]
    push = A.T.tocsr()[free]
    for _ in range(iterations):
        p[free] = factor.solve(push @ (terms.stiffness[:, None] * terms.project_springs(p)) + known)
    return p


def format_matrices(matrices: LocalGlobalMatrices) -> Iterator[str]:
    """Yield the matrices as text, each with its formula."""
    terms, same = matrices.terms, len(np.unique(matrices.k)) == 1
    exact, soft = bool((~terms.soft_mask).any()), bool(terms.soft_mask.any())
    pin = " + w C'C" if soft else ""
    stiffness = f"k = {matrices.k[0]:g} N/m" if same else f"k = {matrices.k.min():g} to {matrices.k.max():g} N/m"
    weight = f", w = {terms.weight[terms.soft_mask][0]:g} N/m" if soft else ""
    yield (
        f"n = {terms.num_vertices} vertices, m = {len(matrices.E)} springs, q = {len(terms.pinned)} pins, "
        f"{stiffness}, dt = {terms.time_step:.6g} s{weight}"
    )
    if exact:
        yield (
            "The pins are exact: they are no part of Q, y and b, and the rows and columns of the pinned vertices "
            "are deleted before Q is factorised."
        )
    target = " + w C'C p_rest" if soft else ""
    of_springs, of_directions = ("k A'A", "k A'd") if same else ("A'KA", "A'K d")
    for name, formula in {
        "E": "each row: the two vertices i, j of a spring, counted from 0",
        "A": "A_ei = +1, A_ej = -1 for spring e = (i, j)",
        "C": "C_qi = 1 for pin q at vertex i",
        "M": "M_ii = m_i [kg]",
        "Q": f"Q = {of_springs} + M/dt^2{pin} [N/m]",
        "y": f"y = M (2 p^t - p^(t-dt))/dt^2 + f_ext{target} [N]",
        "d": "d_e = r_e (p_i - p_j)/|p_i - p_j| [m]",
        "b": f"b = {of_directions} + y [N]",
    }.items():
        yield ""
        yield from _format_one(name, formula, getattr(matrices, name))


def _format_one(name: str, formula: str, matrix: Any) -> Iterator[str]:
    rows, columns = matrix.shape
    stored = f", {matrix.nnz} entries stored" if isinstance(matrix, csr_array) else ""
    yield f"{name}: {rows} x {columns}{stored}.  {formula}"
    part: Any = matrix[:_SHOWN_ROWS, :_SHOWN_COLUMNS]
    shown: Any = part.toarray() if isinstance(part, csr_array) else part
    cells = [[f"{value + 0:.6g}" for value in line] for line in shown.tolist()]  # + 0: no negative zeros
    width = max((len(cell) for line in cells for cell in line), default=0)
    yield from ("  " + " ".join(cell.rjust(width) for cell in line) for line in cells)
    if rows > _SHOWN_ROWS or columns > _SHOWN_COLUMNS:
        yield f"  (the first {shown.shape[0]} rows and {shown.shape[1]} columns; the files have all)"


def save_matrices(matrices: LocalGlobalMatrices, folder: Path) -> list[Path]:
    """Write `matrices.npz` and one Matrix Market file for each matrix.

    In the .npz a sparse matrix X is the four arrays X_data, X_indices, X_indptr and X_shape of
    `scipy.sparse.csr_array`.

    Args:
        matrices: matrices and vectors to write.
        folder: folder of the files, which is created if missing.

    Returns:
        Paths of the files, `matrices.npz` first.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = dict(matrices.dense_arrays)
    for name, matrix in matrices.sparse_matrices.items():
        parts = {"data": matrix.data, "indices": matrix.indices, "indptr": matrix.indptr, "shape": matrix.shape}
        arrays |= {f"{name}_{part}": np.asarray(value) for part, value in parts.items()}
    paths = [folder / "matrices.npz"]
    with atomic_write(paths[0]) as partial:
        np.savez(partial, allow_pickle=False, **arrays)
    written: dict[str, Any] = {
        **matrices.sparse_matrices,
        "E": matrices.E,
        "y": matrices.y,
        "d": matrices.d,
        "b": matrices.b,
    }
    for name, matrix in written.items():
        paths.append(folder / f"{name}.mtx")
        with atomic_write(paths[-1]) as partial:
            mmwrite(str(partial), matrix, precision=17, symmetry="general")
    return paths
