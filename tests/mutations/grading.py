"""Planted errors in what is said of others' positions and matrices: name, file, fragment, replacement, test."""

from __future__ import annotations

from tests.mutations.base import Mutation

_FOLDER = "harness/experiments/grading"
_GRADE, _MATRICES = "tests/unit/test_grade.py", "tests/unit/test_matrices_command.py"
_MOMENTUM = f"{_GRADE}::test_momentum_of_a_scene_without_pins_is_balanced_and_a_lost_impulse_is_measured"
_MISTAKE_TEST = f"{_GRADE}::test_a_correct_program_is_correct_and_a_mistake_is_named"
_MATRIX_TEST = f"{_MATRICES}::test_a_matrix_of_another_program_is_compared_and_stored_zeros_are_counted"

_TABLE = (
    (
        "grade-frame-1-always",
        f"{_FOLDER}/submission.py",
        "first_frame = 0 if is_start else 1",
        "first_frame = 1",
        f"{_GRADE}::test_vertices_in_another_order_are_matched_by_frame_0_and_the_output_states_it",
    ),
    (
        "grade-order-inverted",
        f"{_FOLDER}/submission.py",
        "p = p[:, match.vertices]",
        "p = p[:, np.argsort(match.vertices)]",
        f"{_GRADE}::test_vertices_are_matched_by_a_file_of_rest_positions_or_refused",
    ),
    (
        "grade-digits-doubled",
        f"{_FOLDER}/submission.py",
        "unit = 0.5 * 10.0**-decimals",
        "unit = 1.0 * 10.0**-decimals",
        f"{_GRADE}::test_the_stored_digits_are_recognised",
    ),
    (
        "grade-half-a-vertex",
        f"{_FOLDER}/position_files.py",
        "is_wrong = ~(np.abs(column) < 2.0**53) | (column != np.trunc(column))",
        "is_wrong = ~(np.abs(column) < 2.0**53)",
        f"{_GRADE}::test_a_file_that_cannot_be_graded_is_refused_with_its_place",
    ),
    (
        "grade-impulse-of-a-second",
        f"{_FOLDER}/motion_quantities.py",
        "impulse = dt * scene.constant_force.sum(axis=0)",
        "impulse = scene.constant_force.sum(axis=0)",
        _MOMENTUM,
    ),
    (
        "grade-work-added",
        f"{_FOLDER}/motion_quantities.py",
        "energy.append(kinetic[-1] + float(potential) - work)",
        "energy.append(kinetic[-1] + float(potential) + work)",
        _MOMENTUM,
    ),
    (
        "grade-error-of-the-submission",
        f"{_FOLDER}/motion_error.py",
        "                        trajectory.measure_error(k, exact),\n",
        "                        trajectory.measure_error(k, p),\n",
        _MOMENTUM,
    ),
    (
        "grade-fit-inverted",
        f"{_FOLDER}/fingerprints.py",
        "max(0.0, 1.0 - deviation / of_correct)",
        "max(0.0, deviation / of_correct)",
        _MISTAKE_TEST,
    ),
    (
        "grade-iterations-from-0",
        f"{_FOLDER}/fingerprints.py",
        "k = int(np.argmax(by_count <= max(CONVERGED_FACTOR * lowest, noise))) + 1",
        "k = int(np.argmax(by_count <= max(CONVERGED_FACTOR * lowest, noise)))",
        f"{_GRADE}::test_a_scene_without_required_iterations_requires_convergence",
    ),
    (
        "grade-anything-is-a-minimum",
        f"{_FOLDER}/step_verdicts.py",
        "return self.is_stationary and self.gap <= max(CONVERGED_GAP, FLOOR_FACTOR**2 * self.gap_floor)",
        "return self.is_stationary",
        f"{_GRADE}::test_a_saddle_is_no_minimum",
    ),
    (
        "matrix-zeros-uncounted",
        f"{_FOLDER}/matrix_comparison.py",
        "zeros = int((received.data == 0).sum())",
        "zeros = int((received.data != 0).sum())",
        _MATRIX_TEST,
    ),
    (
        "matrix-of-any-sign",
        f"{_FOLDER}/matrix_comparison.py",
        "np.abs(_square(received) - _square(expected)).max()",
        "np.abs(np.abs(_square(received)) - np.abs(_square(expected))).max()",
        _MATRIX_TEST,
    ),
    (
        "matrix-without-pins",
        f"{_FOLDER}/local_global_matrices.py",
        "y[terms.pinned[soft]] += terms.weight[soft, None] * problem.pin_targets[soft]",
        "y[terms.pinned[soft]] += problem.pin_targets[soft]",
        f"{_MATRICES}::test_matrices_are_those_of_plain_numpy",
    ),
)

GRADING = tuple(Mutation(name, file, old, new, (test,)) for name, file, old, new, test in _TABLE)
