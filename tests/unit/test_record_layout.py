"""The layout of a recording: a camera that sees the run, and words that say what is shown."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from springbench.harness.recording.camera_view import ViewExtent
from springbench.harness.recording.strain_scale import NUM_LEVELS
from springbench.harness.recording.viewer_blueprint import (
    build_panels,
    build_plot,
    build_scene_view,
    compute_spring_interval,
    format_run_document,
    format_scale_name,
)
from springbench.harness.scenes.mesh.grid_mesh import GridMesh

from tests.synthetic_recordings import MESHES_BY_KIND, build_recording_info

CORNER = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 2.0]])


def to_array(batch: Any) -> np.ndarray:
    return np.array(batch.as_arrow_array().to_pylist())


def numbers(component: Any) -> np.ndarray:
    """The three numbers of a position in a blueprint."""
    return np.array(component.as_arrow_array().to_pylist()[0])


def project_points(box: ViewExtent, points: np.ndarray, aspect: float) -> np.ndarray:
    """How far points are from the middle of the picture, 1 at its edge, (n, 2): across, up."""
    controls = box.build_eye_controls()
    eye, target = numbers(controls.position), numbers(controls.look_target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, numbers(controls.eye_up))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    depth = (points - eye) @ forward
    tangent = np.tan(np.radians(55 / 2))
    return np.abs(np.stack([(points - eye) @ right / aspect, (points - eye) @ up], axis=1) / depth[:, None] / tangent)


def height(box: ViewExtent, points: np.ndarray) -> np.ndarray:
    """How high points are seen, 1 at the upper edge of the view, -1 at the lower."""
    controls = box.build_eye_controls()
    eye, target = numbers(controls.position), numbers(controls.look_target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, numbers(controls.eye_up))
    up = np.cross(right / np.linalg.norm(right), forward)
    return (points - eye) @ up / ((points - eye) @ forward) / np.tan(np.radians(55 / 2))


@pytest.mark.parametrize("aspect", [0.6, 1.0])
@pytest.mark.parametrize("fall", [0.0, -1.0, -5.0])
def test_the_camera_sees_all_that_happens_and_little_more(aspect: float, fall: float):
    points = np.vstack([CORNER, CORNER + np.array([0.0, fall, 0.0])])
    box = ViewExtent(CORNER, aspect)
    box.add_positions(CORNER)
    box.add_positions(CORNER + np.array([0.0, fall, 0.0]))
    places = project_points(box, points, aspect)
    assert places.max() <= 1.0
    if fall:  # else the nearest camera is nearer than any that has room around it
        assert places.max() > 0.65, "of half the view; the rest of the lower half is the scale's, and 4 % margin"
    strip, numbers_below = box.build_colour_scale(0.1)
    below = to_array(strip.vertex_positions)
    assert project_points(box, below, aspect).max() <= 1.0
    assert to_array(numbers_below.labels).tolist() == ["−10 %", "−5 %", "strain 0", "+5 %", "+10 %"]
    lowest = height(box, points).min()
    assert height(box, below).max() < lowest, "the scale covers no data"


@pytest.mark.parametrize(
    ("ends", "labels"), [((-0.05, 0.39), ["to +39 %"]), ((-0.2, 0.05), ["to −20 %"]), ((-0.1, 0.1), [])]
)
def test_the_scale_ends_in_a_tip_with_a_figure_where_strain_exceeds_it(ends: tuple[float, float], labels: list[str]):
    strip, words = ViewExtent(MESHES_BY_KIND["cloth"].rest_positions).build_colour_scale(0.1, ends)
    assert to_array(words.labels).tolist()[5:] == labels
    assert len(to_array(strip.triangle_indices)) == 2 * (NUM_LEVELS - 1) + len(labels)


def test_a_wide_and_low_mesh_is_centred_above_the_scale():
    flat = np.array([[x, 0.0, z] for x in (0.0, 1.0) for z in (0.0, 1.0)])
    heights = height(ViewExtent(flat), flat)
    above, below = 1.0 - heights.max(), heights.min() + 0.72
    assert above == pytest.approx(below, abs=0.2), "in half views; shares are tried in steps of 0.2"


@pytest.mark.parametrize("bad", [1e6, np.nan, np.inf])
def test_the_camera_ignores_positions_that_have_blown_up(bad: float):
    box, same = ViewExtent(CORNER), ViewExtent(CORNER)
    box.add_positions(CORNER + np.array([[bad, 0.0, 0.0]]))
    assert numbers(box.build_eye_controls().position) == pytest.approx(numbers(same.build_eye_controls().position))


def test_the_camera_omits_vertices_that_fall_away_and_reports_them():
    net = np.array([[x, y, 0.0] for x in (0.0, 0.5, 1.0) for y in (0.0, -0.5)])
    start = np.vstack([net, [[2.0, 0.0, 0.0]]])
    box, without = ViewExtent(start), ViewExtent(net)
    for fallen in (0.1, 3.0, 15.0, 44.0):
        box.add_positions(np.vstack([net, [[2.0, -fallen, 0.0]]]))
        without.add_positions(net)
    assert numbers(box.build_eye_controls().position) == pytest.approx(
        numbers(without.build_eye_controls().position), rel=0.02
    )
    assert box.describe_outside() == ["1 of 7 vertices is outside"]
    assert build_scene_view("", "net", box, springs_visible=True).name == "net, 1 of 7 vertices is outside"
    assert build_scene_view("", "net", without, springs_visible=True).name == "net"


def test_a_recording_opens_at_its_first_frame_playing():
    time, *_ = build_panels(1 / 30)
    assert (time.play_state, time.loop_mode, time.timeline) == ("playing", "all", "frame")


def test_a_plot_ends_at_the_last_frame_and_its_legend_has_room_above_the_data():
    drawn: Any = build_plot("Energies", ["+ /energy/**"], last=40, value_range=(-1.0, 3.0))
    assert drawn.properties["TimeAxis"].view_range.as_arrow_array().to_pylist()[0]["end"] == 40
    low, high = drawn.properties["ScalarAxis"].range.as_arrow_array().to_pylist()[0]
    assert (low, high) == (-1.0, pytest.approx(3.0 + 1.2 * 4.0))


def test_a_camera_can_be_fitted_to_a_single_point():
    assert np.isfinite(numbers(ViewExtent(np.zeros((1, 3))).build_eye_controls().position)).all()


def test_springs_of_small_meshes_are_drawn_in_every_frame():
    assert compute_spring_interval(build_recording_info()) == 1
    mesh = GridMesh().build_mesh(40)
    assert compute_spring_interval(replace(build_recording_info(), mesh=mesh, springs=mesh.springs)) > 10


def test_the_words_name_colours_run_and_machine():
    text = format_run_document(build_recording_info())
    for words in ("cloth - test", "| cpu | `a, b [c]` |", "time step", "blue = compressed 10 %", "/scene/springs"):
        assert words in text
    assert format_scale_name(0.025).count("2.5 %") == 2
