"""The sheet of scenes: a tile for each, and obstacles where they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from springbench.harness.cli.main import app
from springbench.harness.execution import machine_info
from springbench.harness.report import gallery_sheet, opengl_probe
from springbench.harness.report.gallery_sheet import choose_column_count
from springbench.harness.report.obstacle_meshes import build_obstacle_mesh
from springbench.harness.report.provenance_words import describe_machine_and_commit
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.primitive_obstacles import BoxObstacle, CapsuleObstacle, PlaneObstacle, SphereObstacle
from typer.testing import CliRunner

needs_opengl = pytest.mark.skipif(
    opengl_probe.find_opengl_problem() is not None, reason=opengl_probe.find_opengl_problem() or ""
)
SEEN = np.random.default_rng(0).normal(size=(20, 3))

FACTS = ("at the last frame, by hybrid to 1e-4", "strain: blue −10 % or more, orange as much stretched")
SCENE = """
mesh: {kind: chain, length: 1}
mass: 1
time_step: 1/30
frames: 3
default_size: 4
effects:
  - {kind: springs, stretch: 100}
  - {kind: pins, parts: [first]}
"""


@pytest.mark.parametrize(
    "obstacle",
    [
        SphereObstacle(center=(1.0, 2.0, 3.0), radius=0.5),
        CapsuleObstacle(end_points=((0.0, 0.0, 0.0), (1.0, 1.0, 0.0)), radius=0.2),
        BoxObstacle(low=(-1.0, 0.0, 0.0), high=(1.0, 0.5, 2.0)),
        PlaneObstacle(point=(0.0, 1.0, 0.0), normal=(1.0, 1.0, 0.0)),
    ],
    ids=lambda one: one.kind,
)
def test_what_is_drawn_of_an_obstacle_is_its_surface(obstacle):
    made = build_obstacle_mesh(obstacle, 0.0, SEEN)
    assert made is not None
    points = np.asarray(made.points, np.float64)
    distance = obstacle.build_obstacle().signed_distance(points, 0.0)
    # VTK keeps points in single precision. The balls at a capsule's ends are whole: half of each is hidden inside.
    assert distance.max() < 1e-5
    assert np.median(np.abs(distance)) < 1e-5


def test_an_obstacle_is_drawn_where_it_has_moved_to():
    moves = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=2.0, offset=(0.0, 4.0, 0.0))))
    made = build_obstacle_mesh(SphereObstacle(radius=1.0, motion=moves), 1.0, SEEN)
    assert made is not None
    assert np.asarray(made.points).mean(axis=0) == pytest.approx([0.0, 2.0, 0.0], abs=1e-5)  # single precision


def test_the_level_ground_is_not_drawn():
    assert build_obstacle_mesh(PlaneObstacle(), 0.0, SEEN) is None


@needs_opengl
def test_the_sheet_has_a_tile_for_each_scene_and_says_what_drew_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    said: list[list[str]] = []

    def save(page: Figure, path: Path) -> None:
        said.append([text.get_text() for text in page.texts])
        page.savefig(path)

    monkeypatch.setattr(gallery_sheet, "save_page", save)
    paths = [tmp_path / f"scene-{k}.yaml" for k in range(7)]
    for path in paths:
        path.write_text(SCENE)
    sizes, blank = [], []
    for count in (4, 7):
        sheet = tmp_path / "sheet.png"
        result = CliRunner().invoke(app, ["gallery", *map(str, paths[:count]), "-o", str(sheet)])
        assert result.exit_code == 0, result.output
        image = Image.open(sheet).convert("L")
        sizes.append(image.size)
        blank.append(np.asarray(image)[-300:, 1250:].min() > 200)
    assert sizes[0][0] == sizes[1][0] == 1600
    assert sizes[1][1] > sizes[0][1] + 300  # another row
    assert blank == [False, True]  # the last of which is one tile short
    here = {"cpu": machine_info.describe_machine().cpu, "commit": machine_info.read_commit()}
    for page in said:
        assert page[-1] == "   ·   ".join([*FACTS, *describe_machine_and_commit([here])])


def test_a_sheet_leaves_as_few_places_blank_as_it_can():
    assert [choose_column_count(count) for count in (1, 4, 5, 6, 7, 9, 15, 16)] == [1, 4, 5, 3, 4, 3, 3, 4]
    assert all(-count % choose_column_count(count) <= 2 for count in range(1, 60))
