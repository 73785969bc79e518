"""The sheet of scenes: a tile for each, and obstacles where they are."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from springbench.harness.cli.main import app
from springbench.harness.execution import machine_info
from springbench.harness.report import gallery_sheet, opengl_probe
from springbench.harness.report.gallery_sheet import SceneTile, choose_column_count, draw_gallery_sheet
from springbench.harness.report.obstacle_meshes import build_obstacle_mesh
from springbench.harness.report.provenance_words import describe_machine_and_commit
from springbench.harness.scenes.key_frames import KeyFrame, KeyFrameMotion
from springbench.harness.scenes.primitive_obstacles import BoxObstacle, CapsuleObstacle, PlaneObstacle, SphereObstacle
from typer.testing import CliRunner

from tests.unit.test_report_pictures import cloth

needs_opengl = pytest.mark.skipif(
    opengl_probe.find_opengl_problem() is not None, reason=opengl_probe.find_opengl_problem() or ""
)
SAMPLE_POINTS = np.random.default_rng(0).normal(size=(20, 3))

MILLIMETRES, POINTS = 85.0, 5.5
"""Width of a column of print, and the smallest type that is read there."""
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
    made = build_obstacle_mesh(obstacle, 0.0, SAMPLE_POINTS)
    assert made is not None
    points = np.asarray(made.points, np.float64)
    distance = obstacle.build_obstacle().signed_distance(points, 0.0)
    # VTK stores points in single precision. The balls at a capsule's ends are whole: half of each is hidden inside.
    assert distance.max() < 1e-5
    assert np.median(np.abs(distance)) < 1e-5


def test_an_obstacle_is_drawn_where_it_has_moved_to():
    moves = KeyFrameMotion(key_frames=(KeyFrame(time=0.0), KeyFrame(time=2.0, offset=(0.0, 4.0, 0.0))))
    made = build_obstacle_mesh(SphereObstacle(radius=1.0, motion=moves), 1.0, SAMPLE_POINTS)
    assert made is not None
    assert np.asarray(made.points).mean(axis=0) == pytest.approx([0.0, 2.0, 0.0], abs=1e-5)  # single precision


def test_the_level_ground_is_not_drawn():
    assert build_obstacle_mesh(PlaneObstacle(), 0.0, SAMPLE_POINTS) is None


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The sheets that a test draws."""
    found: list[Figure] = []
    monkeypatch.setattr(gallery_sheet, "save_page", lambda page, path: found.append(page))
    return found


def find_overlaps(page: Figure) -> list[tuple[str, str]]:
    """Pairs of texts and images that overlap, and what is outside the page."""
    images: list[Any] = page.images
    boxes: dict[str, Any] = {f"{k}: {text.get_text()}": text.get_window_extent() for k, text in enumerate(page.texts)}
    for k, image in enumerate(images):
        left, right, bottom, top = image.get_extent()
        boxes[f"image {k}"] = Bbox.from_extents(left, bottom, right, top)
    pairs = [(one, other) for one, other in combinations(boxes, 2) if boxes[one].overlaps(boxes[other])]
    whole = page.bbox
    return pairs + [
        (name, "edge")
        for name, box in boxes.items()
        if box.x0 < 0 or box.y0 < 0 or box.x1 > whole.width or box.y1 > whole.height
    ]


def assert_readable(page: Figure) -> None:
    shrunk = MILLIMETRES / (25.4 * page.get_figwidth())
    assert min(float(text.get_fontsize()) for text in page.texts) * shrunk >= POINTS
    assert find_overlaps(page) == []


@needs_opengl
def test_the_sheet_has_a_tile_for_each_scene_and_states_what_drew_it(tmp_path: Path, pages: list[Figure]):
    paths = [tmp_path / f"scene-{k}.yaml" for k in range(7)]
    for path in paths:
        path.write_text(SCENE)
    for count, title in ((4, "Four chains"), (7, "Seven chains")):
        command = ["gallery", *map(str, paths[:count]), "-o", str(tmp_path / "sheet.png"), "--title", title]
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
        page, words = pages[-1], [text.get_text() for text in pages[-1].texts]
        assert words[: count + 1] == [title, *(f"scene {k}" for k in range(count))]
        assert words[count + 1 : count + 5] == ["compressed 10 %", "stretched 10 %", "pinned", "●"]
        here = {"cpu": machine_info.describe_machine().cpu, "commit": machine_info.read_commit()}
        facts = ["at the last frame, by hybrid to 1e-4", *describe_machine_and_commit([here])]
        assert "  ·  ".join(words[count + 5 :]) == "  ·  ".join(facts)
        assert len(page.images) == count + 1, "tiles, and the scale"
        assert all(np.asarray(image.get_array()).min() < 150 for image in page.images)
        assert_readable(page)


@needs_opengl
@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_sheet_of_any_names_is_read_where_it_is_a_column_wide(count: int, tmp_path: Path, pages: list[Figure]):
    replay = cloth(frames=1)
    replay = replace(replay, properties={**replay.properties, "prevents_self_intersection": False})
    names = ["a cloth of a long name that needs several lines", "W" * 90, "flag", "cloth $x$", "gap"]
    tiles = [SceneTile(replay, np.ones(36), name, None) for name in names[:count]]
    draw_gallery_sheet(tiles, tmp_path / "sheet.png", "A title of many words, " * 6, ["solver, " * 30])
    assert_readable(pages[-1])
    words = "".join(text.get_text() for text in pages[-1].texts).replace(" ", "")
    assert all(name.replace(" ", "") in words for name in names[:count])


@needs_opengl
def test_a_scale_has_numbers_where_all_scenes_share_it(tmp_path: Path, pages: list[Figure]):
    one = cloth(frames=1)
    for other, ends in ((0.02, ["compressed", "stretched"]), (one.strain_range, None)):
        tiles = [SceneTile(replace(one, strain_range=end), np.ones(36), "a", None) for end in (one.strain_range, other)]
        draw_gallery_sheet(tiles, tmp_path / "sheet.png", "Scenes")
        percent = f" {100 * one.strain_range:.3g} %"
        words = [text.get_text() for text in pages[-1].texts]
        assert words[3:5] == (ends or [f"compressed{percent}", f"stretched{percent}"])


def test_a_sheet_leaves_as_few_places_blank_as_it_can():
    assert [choose_column_count(count) for count in (1, 4, 5, 6, 7, 9, 15, 16)] == [1, 4, 3, 3, 4, 3, 3, 4]
    assert all(-count % choose_column_count(count) <= 2 for count in range(1, 60))
