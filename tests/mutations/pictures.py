"""Planted errors in recordings, pictures and the page."""

from __future__ import annotations

from tests.mutations.base import Mutation

_RECORDINGS, _READ_BACK, _REPORT_PICTURES, _LAYOUT = (
    "tests/contracts/test_recordings.py",
    "tests/unit/test_record_verify.py",
    "tests/unit/test_report_pictures.py",
    "tests/unit/test_record_layout.py",
)
_SCALES = "tests/unit/test_picture_layout.py"

PICTURES = (
    Mutation(
        "odd-frames-late",
        "harness/recording/rerun_recorder.py",
        "self._buffered.append((frame.index, p,",
        "self._buffered.append((frame.index, self._buffered[-1][1] if self._buffered and frame.index % 2 else p,",
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
        '{"external": step.problem.external_force}',
        '{"external": -step.problem.external_force}',
        ("tests/unit/test_instrumentation_pass.py",),
    ),
    Mutation(
        "origin-not-stated",
        "harness/recording/rerun_recorder.py",
        "**build_obstacles_property(info.obstacles), **build_origin_property(self._origin)}",
        "**build_obstacles_property(info.obstacles)}",
        (_READ_BACK,),
    ),
    Mutation(
        "origin-subtracted-twice",
        "harness/recording/recorder_interface.py",
        "self.positions[frame] + self.origin",
        "self.positions[frame] - self.origin",
        (_READ_BACK,),
    ),
    Mutation(
        "coarse-positions-pass",
        "harness/recording/recording_check.py",
        "        if coarse:\n",
        "        if False:\n",
        (_READ_BACK,),
    ),
    Mutation(
        "samples-of-one-array",
        "harness/recording/recorder_interface.py",
        "self.positions[frame] = p.copy()",
        "self.positions[frame] = p",
        (_READ_BACK,),
    ),
    Mutation(
        "runaway-framed",
        "harness/recording/camera_framing.py",
        "gaps = gaps[gaps >= least]",
        "gaps = gaps[gaps < least]",
        (_REPORT_PICTURES,),
    ),
    Mutation(
        "outside-miscounted",
        "harness/recording/camera_framing.py",
        "count = int((~framed).sum())",
        "count = int(framed.sum())",
        (_REPORT_PICTURES,),
    ),
    Mutation(
        "obstacles-not-moved-to-the-origin",
        "harness/report/obstacle_meshes.py",
        "made.points = points - origin",
        "made.points = points",
        (_REPORT_PICTURES,),
    ),
    Mutation(
        "intersections-unsaid",
        "harness/report/self_intersection_notes.py",
        "for k in frames)",
        "for k in ())",
        (_REPORT_PICTURES,),
    ),
    Mutation(
        "replay-opens-at-its-end",
        "harness/recording/viewer_blueprint.py",
        'play_state="playing"',
        'play_state="following"',
        (_LAYOUT,),
    ),
    Mutation(
        "scale-of-runaway",
        "harness/report/drawable_frames.py",
        "framed = near[replay.springs].all(axis=1)",
        "framed = near[replay.springs].any(axis=1)",
        (_SCALES,),
    ),
    Mutation(
        "recorded-scale-of-runaway",
        "harness/recording/strain_shading.py",
        "framed = near[springs].all(axis=1)",
        "framed = near[springs].any(axis=1)",
        (_SCALES,),
    ),
    Mutation(
        "scale-of-diverged-iterates",
        "harness/report/site/mesh_scripts.py",
        "np.quantile(known, 0.99)",
        "known.max()",
        (_SCALES,),
    ),
    Mutation(
        "self-contact-inverted",
        "harness/recording/rerun_recorder.py",
        "= info.has_self_contact",
        "= not info.has_self_contact",
        (_RECORDINGS,),
    ),
    Mutation(
        "names-past-their-tile",
        "harness/report/gallery_sheet.py",
        "in wrap_to_width(words, width, _TEXT_SIZE):",
        "in [words]:",
        ("tests/unit/test_gallery.py::test_a_sheet_of_any_names_is_read_where_it_is_a_column_wide",),
    ),
)
