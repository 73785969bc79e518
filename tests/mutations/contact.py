"""Planted errors in contact: friction, barrier, continuous collision detection, candidates, obstacles.

Name, file, fragment, replacement, test.
"""

from __future__ import annotations

from tests.mutations.base import Mutation

_C, _U = "solvers/contact", "tests/unit"
_FRICTION, _CCD, _PAIRS = (f"{_U}/test_{name}.py" for name in ("friction", "ccd", "self_contact"))

_TABLE = (
    (
        "friction-of-the-start",
        f"{_C}/friction_rounds.py",
        "pressed=x)",
        "pressed=problem.start.positions)",
        f"{_FRICTION}::test_other_integrators_take_the_pressure_of_their_unknown",
    ),
    (
        "friction-ends-early",
        f"{_C}/friction_rounds.py",
        "TOLERANCE = 1e-4",
        "TOLERANCE = 2.0",
        f"{_FRICTION}::test_rounds_are_done_where_friction_acts_and_nowhere_else",
    ),
    (
        "creep-per-step",
        f"{_C}/energy.py",
        "slip=self.creep * lasts",
        "slip=self.creep / 60.0",
        f"{_FRICTION}::test_what_sticks_creeps_at_a_speed_whatever_the_step",
    ),
    (
        "barrier-force",
        f"{_C}/barrier.py",
        "out[k] = -m * contacts.stiffness[k]",
        "out[k] = -0.9 * m * contacts.stiffness[k]",
        f"{_FRICTION}::test_a_sheet_on_a_sheet_has_the_steps_own_pressure_too",
    ),
    (
        "barrier-mollifier-force",
        f"{_C}/barrier.py",
        "m = mollifier(contacts.crossed[k], contacts.parallel[k])[0]",
        "m = 1.0",
        f"{_PAIRS}::test_friction_of_nearly_parallel_edges_has_the_barriers_force",
    ),
    (
        "ccd-bound",
        f"{_C}/ways.py",
        "return max(l0, l1) + max(l2, l3) if edges else l0 + max(l1, l2, l3)",
        "return 0.8 * (max(l0, l1) + max(l2, l3) if edges else l0 + max(l1, l2, l3))",
        _CCD,
    ),
    (
        "ccd-bound-of-eight",
        f"{_C}/ways.py",
        "bits((root(dot(z, z)) - pairs.thickness) * (1.0 - LEFT) >= _WIDER * most * speed)",
        "bits((root(dot(z, z)) - pairs.thickness) * (1.0 - LEFT) >= 0.8 * most * speed)",
        _CCD,
    ),
    (
        "ccd-kept",
        f"{_C}/known.py",
        "if one.p.shape == p.shape and 2.0 * (_apart(one.p, p) + fast) <=",
        "if one.p.shape == p.shape and 2.0 * _apart(one.p, p) + fast <=",
        _CCD,
    ),
    (
        "candidates-outdated",
        f"{_C}/known.py",
        "if self.idle else 2.0 * _apart(self.p, p)",
        "if self.idle else _apart(self.p, p)",
        _PAIRS,
    ),
    (
        "candidates-culled",
        f"{_C}/trees.py",
        "left &= -1 << max(0, first_of_eight + k - first + 1)",
        "left &= -1 << max(0, first_of_eight + k - first + 2)",
        _PAIRS,
    ),
    (
        "obstacle-of-the-start",
        f"{_C}/self_contact.py",
        "np.concatenate([start.pressed, end])",
        "np.concatenate([start.pressed, begun])",
        f"{_FRICTION}::test_a_floor_that_slides_and_rises_takes_a_sheet_along_from_the_first_step_on",
    ),
)

CONTACT = tuple(Mutation(name, file, old, new, (tests,)) for name, file, old, new, tests in _TABLE)
