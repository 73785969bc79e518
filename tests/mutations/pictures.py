"""Lies in recordings, pictures and the page, as `tests.mutations.measuring` has others."""

from __future__ import annotations

from tests.mutations.base import Mutation

_RERUN, _VERIFY, _BASE = (f"harness/record/{name}.py" for name in ("rerun", "verify", "base"))
_RECORDINGS, _READ_BACK, _DRAWN, _LAYOUT = (
    "tests/contracts/test_recordings.py",
    "tests/unit/test_record_verify.py",
    "tests/unit/test_report_pictures.py",
    "tests/unit/test_record_layout.py",
)

PICTURES = (
    Mutation(
        "odd-frames-late",
        _RERUN,
        "self._held.append((frame.index, p,",
        "self._held.append((frame.index, self._held[-1][1] if self._held and frame.index % 2 else p,",
        (_RECORDINGS,),
        ("sparse", "other positions"),
    ),
    Mutation(
        "arrows-reversed",
        "harness/recording/force_arrows.py",
        "vectors=self._scale[name] * f",
        "vectors=-self._scale[name] * f",
        (_RECORDINGS,),
    ),
    Mutation(
        "external-forces-reversed",
        "harness/simulation/instrumentation_pass.py",
        '{"external": step.problem.force}',
        '{"external": -step.problem.force}',
        ("tests/unit/test_observe.py",),
    ),
    Mutation(
        "origin-not-stated",
        _RERUN,
        "**declared(info.obstacles), **origin_property(self._origin)}",
        "**declared(info.obstacles)}",
        (_READ_BACK,),
    ),
    Mutation(
        "origin-subtracted-twice",
        _BASE,
        "self.positions[frame] + self.origin",
        "self.positions[frame] - self.origin",
        (_READ_BACK,),
    ),
    Mutation("coarse-positions-pass", _VERIFY, "        if coarse:\n", "        if False:\n", (_READ_BACK,)),
    Mutation(
        "samples-of-one-array", _BASE, "self.positions[frame] = p.copy()", "self.positions[frame] = p", (_READ_BACK,)
    ),
    Mutation(
        "runaway-framed",
        "harness/recording/camera_framing.py",
        "gaps = gaps[gaps >= least]",
        "gaps = gaps[gaps < least]",
        (_DRAWN,),
    ),
    Mutation(
        "outside-miscounted",
        "harness/recording/camera_framing.py",
        "count = int((~framed).sum())",
        "count = int(framed.sum())",
        (_DRAWN,),
    ),
    Mutation(
        "obstacles-not-moved-to-the-origin",
        "harness/report/obstacle_meshes.py",
        "made.points = points - origin",
        "made.points = points",
        (_DRAWN,),
    ),
    Mutation(
        "intersections-unsaid",
        "harness/report/self_intersection_notes.py",
        "for k in frames)",
        "for k in ())",
        (_DRAWN,),
    ),
    Mutation(
        "replay-opens-at-its-end",
        "harness/recording/viewer_blueprint.py",
        'play_state="playing"',
        'play_state="following"',
        (_LAYOUT,),
    ),
)
