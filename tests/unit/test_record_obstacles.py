"""Obstacles in recordings: seen at the distance of contact, in each frame, and absent where there are none."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.recording.recording_reader import open_recording_source, read_replay
from springbench.harness.report.obstacle_meshes import build_obstacle_meshes, points_to_frame
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.primitive_obstacles import BoxObstacle, CapsuleObstacle, PlaneObstacle, SphereObstacle
from springbench.harness.scenes.surface_obstacles import parse_obstacles

from tests.synthetic_recordings import TIME_STEP, build_recording_info, write_recording

RISES = KeyFrameMotion(
    key_frames=(KeyFrame(time=0.0), KeyFrame(time=10 * TIME_STEP, offset=(0.0, 2.0, 0.0), angle=90.0)),
    axis=(1.0, 2.0, 0.0),
)
OBSTACLES = (
    SphereObstacle(center=(1.0, 2.0, 3.0), radius=0.5, motion=RISES),
    CapsuleObstacle(end_points=((0.0, 0.5, 0.0), (1.0, -1.0, 0.3)), radius=0.2),
    CapsuleObstacle(end_points=((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)), radius=0.2),
    BoxObstacle(low=(-1.0, 0.0, 0.0), high=(1.0, 0.5, 2.0), motion=RISES),
    PlaneObstacle(point=(0.0, 1.0, 0.0), normal=(1.0, 1.0, 0.0)),
)


def rows(path: Path, entity: str) -> dict[str, Any]:
    """All that was logged at an entity: by component the values of its rows."""
    found: dict[str, Any] = {}
    with open_recording_source(path) as source:
        for chunk in source.iterate_chunks(content=entity):
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                found.setdefault(name.rpartition(":")[2], []).extend(batch[name].to_pylist())
    return found


@pytest.fixture(scope="module")
def recording_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(
        tmp_path_factory.mktemp("obstacles") / "a.rrd", build_recording_info(obstacles=OBSTACLES), frame_count=11
    )


def test_a_recording_declares_its_obstacles_as_a_scene_does(recording_path: Path):
    assert parse_obstacles(str(read_replay(recording_path).properties["obstacles"])) == OBSTACLES


def test_each_shape_is_recorded_once_with_its_extents(recording_path: Path):
    sphere, box = rows(recording_path, "/scene/obstacles/0-sphere"), rows(recording_path, "/scene/obstacles/3-box")
    assert (sphere["half_sizes"], sphere["centers"]) == ([[[0.5] * 3]], [[[1.0, 2.0, 3.0]]])
    assert (box["half_sizes"], box["centers"]) == ([[[1.0, 0.25, 1.0]]], [[[0.0, 0.25, 1.0]]])
    (corners,) = rows(recording_path, "/scene/obstacles/4-plane")["vertex_positions"]
    np.testing.assert_allclose(
        OBSTACLES[4].build_obstacle().signed_distance(np.array(corners), 0.0), 0.0, atol=1e-6
    )  # float32
    middle = build_recording_info().mesh.rest_positions.mean(axis=0)
    assert (
        np.linalg.norm(corners - middle, axis=1).min() > build_recording_info().mesh.bounding_box_diagonal
    )  # it reaches beyond the mesh on all sides


@pytest.mark.parametrize("k", [1, 2])
def test_a_capsule_is_turned_from_the_axis_z_to_its_own(recording_path: Path, k: int):
    found, obstacle = rows(recording_path, f"/scene/obstacles/{k}-capsule"), OBSTACLES[k]
    assert isinstance(obstacle, CapsuleObstacle)
    ((turn,),), ((length,),), ((start,),) = (found[n] for n in ("rotation_axis_angles", "lengths", "translations"))
    x, y, z = np.array(turn["axis"]) / np.linalg.norm(turn["axis"])
    assert turn["angle"] == pytest.approx(np.pi)
    end = np.array(start) + length * np.array([2 * x * z, 2 * y * z, 2 * z * z - 1])  # half a turn of (0, 0, length)
    np.testing.assert_allclose([start, end], obstacle.end_points, atol=1e-6)  # float32


def test_moving_obstacles_have_a_transform_in_each_frame_and_resting_ones_none(recording_path: Path):
    moved = rows(recording_path, "/scene/obstacles/0-sphere")
    assert "translation" not in rows(recording_path, "/scene/obstacles/1-capsule")
    centers = [
        np.array(m).reshape(3, 3).T @ OBSTACLES[0].center + t
        for (m,), (t,) in zip([v for v in moved["mat3x3"] if v], [v for v in moved["translation"] if v], strict=True)
    ]
    expected = [RISES.transform_points(np.array([OBSTACLES[0].center]), k * TIME_STEP)[0] for k in range(11)]
    np.testing.assert_allclose(centers, expected, atol=1e-5)  # float32, of positions of some metres


def test_pictures_see_the_obstacles_where_they_are(recording_path: Path):
    replay = read_replay(recording_path, [0, 10])
    assert len(build_obstacle_meshes(replay, 0)) == len(OBSTACLES)
    for frame, time in ((0, 0.0), (1, 10 * TIME_STEP)):
        sphere = np.asarray(build_obstacle_meshes(replay, frame)[0].points, np.float64)
        np.testing.assert_allclose(
            OBSTACLES[0].build_obstacle().signed_distance(sphere, time), 0.0, atol=1e-5
        )  # float32
    assert len(points_to_frame(replay, [0, 1])) > 2 * replay.positions.shape[1]


def test_a_recording_without_obstacles_has_no_trace_of_any(tmp_path: Path):
    path = write_recording(tmp_path / "a.rrd", frame_count=3)
    replay = read_replay(path)
    assert "obstacles" not in replay.properties
    assert build_obstacle_meshes(replay, 0) == []
    np.testing.assert_array_equal(points_to_frame(replay, [0]), replay.positions[0])
    with open_recording_source(path) as source:
        assert list(source.iterate_chunks(content="/scene/obstacles/**")) == []


def test_recording_and_drawing_a_scene_without_obstacles_does_not_import_them():
    imports = "import sys, springbench.harness.experiments.run_pipeline, springbench.harness.report.run_picture"
    script = f"{imports}; sys.exit('springbench.harness.scenes.primitive_obstacles' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
