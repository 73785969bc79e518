"""Planted errors in factorisations by threads, the hybrid, the check for saddles, idle contact and friction's law."""

from __future__ import annotations

from tests.mutations.base import Mutation

_U = "tests/unit"
_BLOCKS, _SADDLES = (f"{_U}/test_{name}.py" for name in ("block_cholesky", "saddle_check"))
_ENDS = "tests/stability/test_saddles.py::test_a_step_that_starts_at_a_saddle_ends_at_a_minimum_below_it"
_IDLE = (
    "tests/contracts/test_self_contact_solvers.py::test_an_iterate_without_contact_counts_only_where_its_path_is_free"
)

_TABLE = (
    (
        "thread-error-lost",
        "solvers/linalg/cholesky/thread_team.py",
        "    _raise_stored_error(team.signals)\n",
        "    read_shared(team.signals, 0)\n",
        f"{_U}/test_thread_team.py",
    ),
    (
        "block-transposed",
        "solvers/linalg/cholesky/block_multifrontal.py",
        "+= values[e, j, i]",
        "+= values[e, i, j]",
        f"{_BLOCKS}::test_a_solve_agrees_with_scipy",
    ),
    (
        "failed-vertex-of-another-group",
        "solvers/linalg/cholesky/block_cholesky.py",
        "np.argmin(scratch.failures)",
        "np.argmax(scratch.failures)",
        f"{_BLOCKS}::test_a_failure_names_the_vertex_of_its_pivot",
    ),
    (
        "spring-bound-of-one-end",
        "solvers/kernels/curvature_search.py",
        "negative[i] -= lateral if anchor_stiffness[j] == np.inf else 2.0 * lateral",
        "negative[i] -= lateral",
        _SADDLES,
    ),
    (
        "element-bound-of-one-vertex",
        "solvers/kernels/curvature_search.py",
        "(end - first) * joined.coefficients[a] ** 2 * least",
        "joined.coefficients[a] ** 2 * least",
        _SADDLES,
    ),
    (
        "hessian-packets-of-other-springs",
        "solvers/kernels/hessian_packets.py",
        "spring = max(spring, ~spring)",
        "spring = abs(spring)",
        _SADDLES,
    ),
    (
        "hybrid-ends-at-saddles",
        "solvers/methods/newton/hybrid_newton.py",
        "            control.is_minimum\n            or self._prepared",
        "            True\n            or self._prepared",
        _ENDS,
    ),
    (
        "hybrid-shifted-steps-agree",
        "solvers/methods/newton/hybrid_newton.py",
        "self.agrees_with_model = self._level == 0 and ",
        "self.agrees_with_model = ",
        f"{_U}/test_hybrid.py::test_only_a_step_by_the_unmodified_hessian_agrees_with_its_model",
    ),
    (
        "idle-contact-of-a-path",
        "solvers/iteration/idle_contact.py",
        "            and max_step_size(self._energies, self._problem.initial_guess, direction) == 1.0\n",
        "",
        _IDLE,
    ),
    (
        "idle-contact-at-the-end",
        "solvers/iteration/idle_contact.py",
        "            and self._vanish_at(p)\n",
        "",
        _IDLE,
    ),
    (
        "friction-with-a-jump",
        "solvers/contact/potentials/friction_law.py",
        "else length - 0.5 * smoothing_length",
        "else length - 0.4 * smoothing_length",
        f"{_U}/test_friction.py::test_the_force_is_the_slope_of_the_potential_across_the_smoothing_length",
    ),
)

SOLVING = tuple(Mutation(name, file, old, new, (tests,)) for name, file, old, new, tests in _TABLE)
