"""What moves through obstacles between its key times is found, and so are planes that close."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from springbench.harness.scenes.clearance_checks import (
    compute_largest_gap_radius,
    find_first_violation,
    find_sample_times,
    merge_key_times,
)
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.primitive_obstacles import PlaneObstacle, SphereObstacle

POINT = np.array([[0.0, 0.0, 0.0]])
LIMIT = 0.01


def moving(*keys: dict[str, Any], **more: Any) -> KeyFrameMotion:
    return KeyFrameMotion.model_validate({"key_frames": list(keys), **more})


ACROSS = moving({"time": 0.0}, {"time": 1.0, "offset": (4.0, 0.0, 0.0)})
ROUND = moving({"time": 0.0}, {"time": 1.0, "angle": 360.0}, pivot=(2.0, 0.0, 0.0))
SMOOTH = moving({"time": 0.0}, {"time": 1.0, "offset": (4.0, 0.0, 0.0)}, interpolation="smooth")
BALL = SphereObstacle(center=(2.0, 0.0, 0.0), radius=0.1)
FAR = SphereObstacle(center=(4.0, 0.0, 0.0), radius=0.05)


# The way is one long step and many short ones: the time of contact is where the distance is the limit, or a step later.
@pytest.mark.parametrize(
    ("ball", "motion", "when"),
    [(BALL, ACROSS, 0.4725), (FAR, ROUND, 0.4952), (BALL, SMOOTH, 0.4725)],
    ids=["along a line", "along a circle", "along a cubic"],
)
def test_a_path_through_a_ball_is_found_where_it_begins(ball: SphereObstacle, motion: KeyFrameMotion, when: float):
    found = find_first_violation(ball.build_obstacle(), None, POINT, motion, LIMIT)
    assert found is not None
    assert found[0] == pytest.approx(when, abs=0.01)
    assert found[1].min() < LIMIT


def test_a_ball_that_approaches_is_found_like_a_path_to_it():
    back = moving({"time": 0.0}, {"time": 1.0, "offset": (-4.0, 0.0, 0.0)})
    ball = SphereObstacle(center=(2.0, 0.0, 0.0), radius=0.1, motion=back)
    found = find_first_violation(ball.build_obstacle(), back, POINT, None, LIMIT)
    assert found is not None
    assert found[0] == pytest.approx(0.4725, abs=0.01)


@pytest.mark.parametrize("motion", [None, ACROSS, ROUND, SMOOTH])
def test_a_path_next_to_a_ball_is_intersection_free(motion: KeyFrameMotion | None):
    other = SphereObstacle(center=(2.0, 5.0, 0.0), radius=0.1)
    assert find_first_violation(other.build_obstacle(), None, POINT, motion, LIMIT) is None


@pytest.mark.parametrize("motion", [ACROSS, ROUND, SMOOTH])
def test_no_point_is_faster_than_the_bound(motion: KeyFrameMotion):
    times = np.linspace(0.0, 1.0, 1001)
    path = np.array([motion.transform_points(POINT, t)[0] for t in times])
    fastest = np.linalg.norm(np.diff(path, axis=0), axis=1).max() / times[1]
    assert fastest <= motion.bound_speed(0.0, 1.0, POINT) * (1 + 1e-9)  # round-off of differences of 1e-3


@pytest.mark.parametrize(("height", "radius"), [(1.0, 0.5), (0.1, 0.05), (-1.0, -0.5)])
def test_the_gap_between_two_planes_is_that_of_the_largest_ball(height: float, radius: float):
    lid = PlaneObstacle(point=(0.0, height, 0.0), normal=(0.0, -1.0, 0.0))
    assert compute_largest_gap_radius([PlaneObstacle().build_obstacle(), lid.build_obstacle()], 0.0) == pytest.approx(
        radius, abs=1e-9
    )


def test_four_planes_may_leave_no_room_where_any_three_do():
    normals = [(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)]
    planes = [PlaneObstacle(point=normal, normal=normal).build_obstacle() for normal in normals]
    assert compute_largest_gap_radius(planes, 0.0) < 0.0
    assert all(compute_largest_gap_radius(planes[:k] + planes[k + 1 :], 0.0) > 0.0 for k in range(4))


def test_planes_that_turn_are_checked_between_their_keys():
    assert list(find_sample_times([ACROSS])) == [0.0, 1.0]
    assert len(list(find_sample_times([ROUND]))) > 32
    assert merge_key_times(ACROSS, None, KeyFrameMotion(key_frames=(KeyFrame(time=0.5),))) == [0.0, 0.5, 1.0]
