"""Planted errors in contact: friction, barrier, continuous collision detection, candidates, obstacles.

Name, file, fragment, replacement, test.
"""

from __future__ import annotations

from tests.mutations.base import Mutation

_U = "tests/unit"
_FRICTION, _CCD, _PAIRS = (f"{_U}/test_{name}.py" for name in ("friction", "ccd", "self_contact"))

_TABLE = (
    (
        "friction-of-the-start",
        "solvers/contact/lagged_friction.py",
        "normal_force_positions=x)",
        "normal_force_positions=problem.step_start.positions)",
        f"{_FRICTION}::test_other_integrators_take_the_pressure_of_their_unknown",
    ),
    (
        "friction-ends-early",
        "solvers/contact/lagged_friction.py",
        "FRICTION_RTOL = 1e-4",
        "FRICTION_RTOL = 2.0",
        f"{_FRICTION}::test_rounds_are_done_where_friction_acts_and_nowhere_else",
    ),
    (
        "creep-per-step",
        "solvers/contact/half_space/half_space_potential.py",
        "smoothing_length=self.eps_v * lasts",
        "smoothing_length=self.eps_v / 60.0",
        f"{_FRICTION}::test_what_sticks_creeps_at_a_speed_whatever_the_step",
    ),
    (
        "barrier-force",
        "solvers/contact/potentials/barrier.py",
        "out[k] = -m * collisions.stiffness[k]",
        "out[k] = -0.9 * m * collisions.stiffness[k]",
        f"{_FRICTION}::test_a_sheet_on_a_sheet_has_the_steps_own_pressure_too",
    ),
    (
        "barrier-mollifier-force",
        "solvers/contact/potentials/barrier.py",
        "m = edge_edge_mollifier(collisions.cross_squarednorm[k], collisions.mollifier_threshold[k])[0]",
        "m = 1.0",
        f"{_PAIRS}::test_friction_of_nearly_parallel_edges_has_the_barriers_force",
    ),
    (
        "ccd-bound",
        "solvers/contact/ccd.py",
        "return max(l0, l1) + max(l2, l3) if edges else l0 + max(l1, l2, l3)",
        "return 0.8 * (max(l0, l1) + max(l2, l3) if edges else l0 + max(l1, l2, l3))",
        _CCD,
    ),
    (
        "ccd-bound-of-eight",
        "solvers/contact/ccd.py",
        "mask_to_bits(\n        (sqrt_packet(dot3(z, z)) - candidates.min_distance) * (1.0 - "
        "MIN_GAP_FRACTION)\n        >= _ROUNDOFF_FACTOR * max_step * speed\n    )",
        "mask_to_bits((sqrt_packet(dot3(z, z)) - candidates.min_distance) * (1.0 - "
        "MIN_GAP_FRACTION) >= 0.8 * max_step * speed)",
        _CCD,
    ),
    (
        "ccd-kept",
        "solvers/contact/broad_phase/candidate_cache.py",
        "and 2.0 * (_max_displacement_from_mean(one.positions, p) + fast) <=",
        "and 2.0 * _max_displacement_from_mean(one.positions, p) + fast <=",
        _CCD,
    ),
    (
        "candidates-outdated",
        "solvers/contact/broad_phase/candidate_cache.py",
        "if self.is_empty\n            else 2.0 * _max_displacement_from_mean(self.positions, p)",
        "if self.is_empty else _max_displacement_from_mean(self.positions, p)",
        _PAIRS,
    ),
    (
        "candidates-culled",
        "solvers/contact/broad_phase/bvh.py",
        "left &= -1 << max(0, first_of_eight + k - first + 1)",
        "left &= -1 << max(0, first_of_eight + k - first + 2)",
        _PAIRS,
    ),
    (
        "obstacle-of-the-start",
        "solvers/contact/contact_potential.py",
        "np.concatenate([start.normal_force_positions, end])",
        "np.concatenate([start.normal_force_positions, begun])",
        f"{_FRICTION}::test_a_floor_that_slides_and_rises_takes_a_sheet_along_from_the_first_step_on",
    ),
)

CONTACT = tuple(Mutation(name, file, old, new, (tests,)) for name, file, old, new, tests in _TABLE)
