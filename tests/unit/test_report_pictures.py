"""Pictures of runs and comparisons: their size, what is in them, and what happens where nothing can be drawn."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image
from springbench.harness.recording.camera_framing import describe_outside
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.recording.strain_scale import STRAIN_COLOURS
from springbench.harness.report import comparison_picture, gallery_sheet, opengl_probe, page_layout, run_picture
from springbench.harness.report.comparison_picture import draw_comparison_picture
from springbench.harness.report.drawable_frames import find_drawable_frames, framed_vertex_mask
from springbench.harness.report.gallery_sheet import SceneTile, draw_gallery_sheet
from springbench.harness.report.mesh_rendering import (
    OffscreenRenderer,
    choose_view_angles,
    compute_area_vectors,
    fit_camera,
)
from springbench.harness.report.obstacle_meshes import points_to_frame
from springbench.harness.report.plot_style import BACKGROUND_COLOUR, PAGE_HEIGHT, PAGE_WIDTH
from springbench.harness.report.recorded_strain import compute_spring_strain, compute_vertex_strain
from springbench.harness.report.run_picture import PixelBox, draw_run_picture, layout_frames
from springbench.harness.report.self_intersection_notes import describe_self_intersection

needs_opengl = pytest.mark.skipif(
    opengl_probe.find_opengl_problem() is not None, reason=opengl_probe.find_opengl_problem() or ""
)

MAX_STRAIN = 0.1  # strain at the ends of the scale in these tests


def cloth(n: int = 6, frames: int = 8, *, stretch: float = 1.05, triangles: bool = True) -> RecordingReplay:
    """A square cloth in the plane z = 0 that sinks, all its springs at the strain `stretch` - 1."""
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    rest = np.stack([u, -v, 0 * u], axis=-1).reshape(-1, 3)
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = (x.ravel() for x in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    springs = np.concatenate(
        [np.stack([k[:-1].ravel(), k[1:].ravel()], 1), np.stack([k[:, :-1].ravel(), k[:, 1:].ravel()], 1)]
    )
    sinking = np.linspace(0, 0.3, frames)[:, None] * np.array([0.0, -1.0, 0.0])
    return RecordingReplay(
        title="cloth 6 - sparse",
        run_id="0123",
        frames=2 * np.arange(frames),
        times=np.linspace(0.0, 0.28, frames),
        positions=(stretch * rest + sinking[:, None]).astype(np.float32),
        triangles=faces if triangles else np.empty((0, 3), np.int64),
        springs=springs,
        rest_lengths=np.full(len(springs), 1 / (n - 1)),
        pinned_vertices=k[[0, -1], 0],
        strain_range=MAX_STRAIN,
        scalars={"/residual": (2 * np.arange(1, frames), np.geomspace(1e-2, 1e-6, frames - 1))},
        properties={"scene": "cloth", "size": n, "solver": "sparse", "milliseconds_per_step": 1.25},
    )


def chain(n: int = 10) -> RecordingReplay:
    whole = cloth(n, triangles=False)
    links = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    lengths = np.full(n - 1, 1 / (n - 1))
    return replace(
        whole, positions=whole.positions[:, :n], springs=links, rest_lengths=lengths, pinned_vertices=np.array([0])
    )


def break_frame(replay: RecordingReplay, frame: int, value: float = np.nan) -> RecordingReplay:
    positions = replay.positions.copy()
    positions[frame:, 3] = value
    return replace(replay, positions=positions)


def pixels(path: Path) -> NDArray[np.float64]:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(float)


def measure_drawn_share(image: NDArray[np.float64], left: int, top: int, width: int, height: int) -> float:
    """The share of pixels in a region that are far from the colour of the page."""
    region = image[top : top + height, left : left + width]
    return float((np.abs(region - 255 * np.array(to_rgb(BACKGROUND_COLOUR))).max(axis=-1) > 60).mean())


@pytest.fixture
def words(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """All that is written on the pages that a test draws."""
    written: list[str] = []

    def save(sheet: Figure, path: Path, **more: Any) -> None:
        written.extend(text.get_text() for text in sheet.texts)
        page_layout.save_page(sheet, path, **more)

    for module in (run_picture, comparison_picture, gallery_sheet):
        monkeypatch.setattr(module, "save_page", save)
    return written


@pytest.fixture
def boxes(monkeypatch: pytest.MonkeyPatch) -> Callable[[], tuple[PixelBox, list[PixelBox]]]:
    """Where the frames of the last run were drawn."""
    found: list[tuple[PixelBox, list[PixelBox]]] = []

    def record_layout(*given: Any) -> tuple[PixelBox, list[PixelBox]]:
        found.append(layout_frames(*given))
        return found[-1]

    monkeypatch.setattr(run_picture, "layout_frames", record_layout)
    return lambda: found[-1]


@needs_opengl
@pytest.mark.parametrize("make", [cloth, lambda: cloth(triangles=False), chain], ids=["cloth", "net", "chain"])
def test_a_run_is_drawn_large_and_four_frames_before_it(
    make: Callable[[], RecordingReplay], boxes: Callable[[], tuple[PixelBox, list[PixelBox]]], tmp_path: Path
) -> None:
    draw_run_picture(make(), tmp_path / "run.png")
    image = pixels(tmp_path / "run.png")
    assert image.shape == (PAGE_HEIGHT, PAGE_WIDTH, 3)
    # A chain covers the fewest pixels: a rod of about 10 x 400 of 1244 x 750.
    main, tiles = boxes()
    assert measure_drawn_share(image, *main) > 0.002
    for tile in tiles:
        assert measure_drawn_share(image, *tile) > 0.0005
    assert [file.name for file in tmp_path.iterdir()] == ["run.png"], "no partial file is left"


@needs_opengl
def test_the_title_names_scene_size_solver_counts_and_cost(words: list[str], tmp_path: Path) -> None:
    draw_run_picture(cloth(), tmp_path / "run.png")
    text = "\n".join(words)
    for said in ("cloth, size 6", "sparse", "36 vertices, 60 springs", "1.25 ms a step", "+5 %", "−5 %", "pinned"):
        assert said in text


@needs_opengl
@pytest.mark.parametrize(("strain", "colour"), list(zip((-0.1, -0.05, 0.0, 0.05, 0.1), STRAIN_COLOURS, strict=True)))
def test_a_uniform_strain_has_the_documented_colour(strain: float, colour: str) -> None:
    replay = cloth(stretch=1 + strain)
    view = fit_camera(replay.positions[0], aspect=1.0, angles=(0.0, 0.0))
    with OffscreenRenderer(160, 160) as studio:
        image = studio.render_frame(replay, 0, view)
    found = seen_colour(image)
    # Light and mesh lines change a facing surface's brightness by up to a tenth; the colours differ by more.
    assert np.abs(found - to_rgb(colour)).max() < 0.1


def seen_colour(image: NDArray[np.float64] | NDArray[np.uint8]) -> NDArray[np.float64]:
    """The colour in the middle of a square picture, each channel from 0 to 1."""
    return np.median(image[60:100, 60:100].reshape(-1, 3), axis=0) / 255


def build_strained_frames(triangles: bool) -> tuple[RecordingReplay, list[RecordingReplay]]:
    """A cloth or a net in three frames, compressed, at rest, and stretched; and each of them alone."""
    frames = [cloth(frames=1, stretch=1 + strain, triangles=triangles) for strain in (-0.1, 0.0, 0.1)]
    whole = cloth(frames=3, triangles=triangles)
    return replace(whole, positions=np.concatenate([frame.positions for frame in frames])), frames


@needs_opengl
@pytest.mark.parametrize("triangles", [True, False], ids=["cloth", "net"])
def test_each_frame_is_drawn_as_it_would_be_alone(triangles: bool) -> None:
    replay, frames = build_strained_frames(triangles)
    view = fit_camera(frames[1].positions[0], aspect=1.0, angles=(20.0, 10.0))
    with OffscreenRenderer(160, 160) as studio:
        together = [studio.render_frame(replay, k, view) for k in range(3)]
        alone = [studio.render_frame(frame, 0, view) for frame in frames]
    for k in range(3):
        np.testing.assert_array_equal(together[k], alone[k])
        assert not np.array_equal(together[k], together[k - 1])


@needs_opengl
def test_each_frame_is_rendered_once() -> None:
    replay, frames = build_strained_frames(True)
    view = fit_camera(frames[1].positions[0], aspect=1.0, angles=(20.0, 10.0))
    rendered = list[str]()
    with OffscreenRenderer(160, 160) as studio:
        studio.render_frame(replay, 0, view)
        window: Any = studio._plotter.render_window
        window.AddObserver("EndEvent", lambda _, event: rendered.append(event))
        for k in (1, 2):
            studio.render_frame(replay, k, view)
    assert len(rendered) == 2


@needs_opengl
def test_each_frame_is_drawn_in_its_own_colours_and_positions() -> None:
    """Drawn out of order, by one window."""
    replay, frames = build_strained_frames(True)
    view = fit_camera(frames[1].positions[0], aspect=1.0, angles=(0.0, 0.0))
    with OffscreenRenderer(160, 160) as studio:
        seen = {k: studio.render_frame(replay, k, view) for k in (2, 0, 1)}
    for k, colour in zip((0, 1, 2), STRAIN_COLOURS[::2], strict=True):
        # As above.
        assert np.abs(seen_colour(seen[k]) - to_rgb(colour)).max() < 0.1
    shares = [measure_drawn_share(seen[k].astype(float), 0, 0, 160, 160) for k in (0, 1, 2)]
    assert shares[0] < shares[2], "a stretched cloth covers more"
    for k, frame in enumerate(frames):
        assert compute_spring_strain(replay, k) == pytest.approx(compute_spring_strain(frame, 0))
        assert compute_vertex_strain(replay, k) == pytest.approx(compute_vertex_strain(frame, 0))


def test_a_vertex_shows_its_most_strained_spring_with_its_sign() -> None:
    replay = chain(4)
    positions = np.array([[[0, 0, 0], [0, -0.3, 0], [0, -0.7, 0], [0, -1.0, 0]]], np.float32)
    replay = replace(replay, positions=positions, rest_lengths=np.array([1, 1, 0]) / 3)
    expected = np.array([-0.1, 0.2, 0.0])
    # Positions are recorded in float32.
    assert compute_spring_strain(replay, 0) == pytest.approx(expected, abs=1e-6)
    assert compute_vertex_strain(replay, 0) == pytest.approx([-0.1, 0.2, 0.2, 0.0], abs=1e-6)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 1.7])
@pytest.mark.parametrize("angles", [(0.0, 0.0), (32.0, 20.0), (-148.0, 15.0)])
def test_the_camera_sees_every_point_from_near_by(aspect: float, angles: tuple[float, float]) -> None:
    points = np.random.default_rng(7).normal(size=(50, 3)) * [3.0, 1.0, 2.0]
    view = fit_camera(points, aspect=aspect, angles=angles)
    forward = view.target - view.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    offset = points - view.position
    depth = offset @ forward
    edge = np.tan(np.radians(12.0))
    across, up = offset @ right / depth / (aspect * edge), offset @ np.cross(right, forward) / depth / edge
    assert (depth > 0).all()
    # The edge is at 1; the shadow, which must be seen too, takes up some of the view.
    assert 0.5 < max(np.abs(across).max(), np.abs(up).max()) < 1.0


def test_the_view_is_from_the_side_where_most_surface_shows() -> None:
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 0.7, 0.7], [0.0, -0.7, 0.7]], np.float32)
    chosen = []
    for side in (1, -1):
        replay = cloth()
        replay = replace(replay, positions=replay.positions @ tilt * np.array([1, 1, side], np.float32))
        areas = compute_area_vectors(replay, -1)
        azimuth, elevation = choose_view_angles(replay.positions[-1], areas)
        shown = {}
        for corner in (32.0, -32.0, 148.0, -148.0):
            a, e = np.radians([corner, elevation])
            towards = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
            shown[corner] = np.abs(areas @ towards).sum()
        # The usual corner is chosen unless another shows more than a twentieth more.
        assert shown[azimuth] >= max(shown.values()) / 1.05
        chosen.append(abs(azimuth) < 90)
    assert sorted(chosen) == [False, True], "mirrored scenes are seen from opposite sides"


@needs_opengl
@pytest.mark.parametrize("make", [cloth, chain], ids=["cloth", "chain"])
@pytest.mark.parametrize("scale", [2.0**-30, 2.0**40], ids=["nanometres", "terametres"])
def test_a_picture_does_not_depend_on_the_unit_of_length(make: Callable[[], RecordingReplay], scale: float) -> None:
    plain = make()
    scaled = replace(plain, positions=np.float32(scale) * plain.positions, rest_lengths=scale * plain.rest_lengths)
    images = []
    with OffscreenRenderer(80, 80) as studio:
        for replay in (plain, scaled):
            assert len(find_drawable_frames(replay)) == len(replay.frames)
            images.append(
                studio.render_frame(
                    replay, 7, fit_camera(points_to_frame(replay, [7]), aspect=1.0, angles=(20.0, 10.0))
                )
            )
    np.testing.assert_array_equal(*images)
    assert measure_drawn_share(images[0].astype(float), 0, 0, 80, 80) > 0.01


@needs_opengl
def test_obstacles_far_from_zero_are_drawn_as_near_it() -> None:
    """Of the same numbers: an origin that is a multiple of a power of two moves nothing by less than that."""
    far = np.array([2.0**25, -(2.0**25), 2.0**24])
    turns = {"key_frames": [{"time": 0}, {"time": 1, "offset": [0, 0.25, 0], "angle": 90}], "axis": [0, 1, 0]}

    def obstacles(o: NDArray[np.float64]) -> str:
        def at(*p: float) -> list[float]:
            return (o + p).tolist()

        sphere = {"kind": "sphere", "center": at(0.5, -1.0, 0), "radius": 0.25}
        capsule = {"kind": "capsule", "end_points": [at(0, -1.5, 0), at(1, -1.5, 0)], "radius": 0.1}
        box = {"kind": "box", "low": at(0, -2, 0), "high": at(0.5, -1.75, 0.25)}
        plane = {"kind": "plane", "point": at(0, 0, -1), "normal": [0, 0, 1]}
        return json.dumps([sphere, capsule, box | {"motion": turns | {"pivot": at(0, 0, 0)}}, plane])

    images = []
    with OffscreenRenderer(80, 80) as studio:
        for o in (np.zeros(3), far):
            plain = cloth()
            replay = replace(plain, origin=o, properties={**plain.properties, "obstacles": obstacles(o)})
            images.append(
                studio.render_frame(
                    replay, 7, fit_camera(points_to_frame(replay, [7]), aspect=1.0, angles=(20.0, 10.0))
                )
            )
    changed = (np.abs(images[0].astype(int) - images[1]).max(axis=2) > 8).mean()
    assert changed < 0.005, "of the pixels; turned corners are rounded at 33,000 km"


@needs_opengl
def test_a_mesh_without_springs_is_drawn_by_its_vertices(tmp_path: Path) -> None:
    plain = chain()
    draw_run_picture(
        replace(plain, springs=plain.springs[:0], rest_lengths=plain.rest_lengths[:0]), tmp_path / "run.png"
    )
    assert measure_drawn_share(pixels(tmp_path / "run.png"), 0, 114, PAGE_WIDTH, 750) > 0.0001


def falling(replay: RecordingReplay, vertices: slice, metres: float) -> RecordingReplay:
    """Some vertices fall by so much until the last frame."""
    positions = replay.positions.copy()
    positions[:, vertices, 1] -= metres * np.linspace(0, 1, len(positions))[:, None].astype(np.float32) ** 2
    return replace(replay, positions=positions)


LEFT_OUT = {
    "nobody falls": (slice(0, 0), 0.0, 0),
    "one vertex": (slice(3, 4), 44.0, 1),
    "half of the mesh": (slice(18, 36), 44.0, 18),
    "two thirds of it": (slice(12, 36), 44.0, 24),
    "all but one vertex": (slice(1, 36), 44.0, 0),
    "all of it": (slice(0, 36), 44.0, 0),
    "not far": (slice(3, 4), 1.5, 0),
}


@pytest.mark.parametrize(("vertices", "metres", "count"), LEFT_OUT.values(), ids=LEFT_OUT)
def test_vertices_far_from_the_others_are_not_framed(vertices: slice, metres: float, count: int) -> None:
    replay = falling(cloth(), vertices, metres)
    found = framed_vertex_mask(replay, range(8))
    assert np.flatnonzero(~found).tolist() == list(range(36))[vertices][:count]
    points = points_to_frame(replay, range(8))
    assert (np.ptp(points, axis=0).max() < 3.0) == (count > 0 or metres < 2.0)
    expected = {0: [], 1: ["1 of 36 vertices is outside"]}.get(count, [f"{count} of 36 vertices are outside"])
    assert describe_outside(found) == expected


SURFACES = {
    "a cloth that is kept apart": (True, 0.0, []),
    "a cloth that is not": (False, 0.0, ["no self-contact"]),
    "folded through itself": (False, 0.5, ["no self-contact: passes through itself"]),
}


@pytest.mark.parametrize(("apart", "folded", "expected"), SURFACES.values(), ids=SURFACES)
def test_a_picture_states_that_a_surface_has_no_self_contact(apart: bool, folded: float, expected: list[str]) -> None:
    """Folded: one corner of the cloth is pushed through its middle."""
    plain = cloth()
    positions = plain.positions.copy()
    positions[7, 35] = positions[7, 14] + [0.05, 0.05, -folded]
    positions[7, 34] += [0, 0, np.float32(folded)]
    replay = replace(plain, positions=positions, properties={**plain.properties, "prevents_self_intersection": apart})
    if not folded:
        replay = replace(replay, positions=plain.positions)
    assert describe_self_intersection(replay, [0, 7]) == expected
    assert apart or describe_self_intersection(replay, [0]) == ["no self-contact"]
    assert describe_self_intersection(plain, [7]) == [], "a recording that does not say is not judged"
    net = replace(replay, triangles=replay.triangles[:0])
    assert describe_self_intersection(net, [7]) == [], "a net has no surface"


@needs_opengl
@pytest.mark.slow
def test_every_picture_of_a_surface_states_that_it_has_no_self_contact(words: list[str], tmp_path: Path) -> None:
    replay = replace(cloth(frames=1), properties={**cloth().properties, "prevents_self_intersection": False})
    draw_run_picture(replay, tmp_path / "run.png")
    draw_comparison_picture({"a": replay}, tmp_path / "both.png")
    sheet = [SceneTile(replay, np.ones(36), "cloth", None)] * 4
    draw_gallery_sheet(sheet, tmp_path / "sheet.png", "Scenes")
    assert "\n".join(words).replace("self-\n", "self-").count("no self-contact") == 1 + 1 + 4


def test_what_is_stretched_evenly_is_framed_whole() -> None:
    replay = chain()
    pulled = replay.positions * np.linspace(1, 100, 8, dtype=np.float32)[:, None, None]
    assert framed_vertex_mask(replace(replay, positions=pulled), range(8)).all()


def test_where_one_point_is_framed_the_start_gives_the_size() -> None:
    replay = chain(2)
    replay = falling(
        replace(replay, springs=replay.springs[:0], rest_lengths=replay.rest_lengths[:0]), slice(1, 2), 490.0
    )
    replay.positions[:, 0] = replay.positions[0, 0]
    assert framed_vertex_mask(replay, [7]).tolist() == [True, False]
    assert np.ptp(points_to_frame(replay, [7]), axis=0).max() == pytest.approx(1.05)


@needs_opengl
def test_a_picture_states_how_many_vertices_are_outside(words: list[str], tmp_path: Path) -> None:
    replay = falling(cloth(), slice(3, 4), 44.0)
    draw_run_picture(replay, tmp_path / "run.png")
    assert sum("1 of 36 vertices is outside" in word for word in words) == 1, words
    assert measure_drawn_share(pixels(tmp_path / "run.png"), 36, 114, 700, 750) > 0.05, "the cloth is no dot"
    words.clear()
    draw_comparison_picture({"a": replay, "b": cloth()}, tmp_path / "both.png")
    assert words.count("1 of 36 vertices is outside") == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_frames_are_drawn_up_to_the_first_that_is_not_finite(value: float) -> None:
    assert find_drawable_frames(cloth()).tolist() == list(range(8))
    assert find_drawable_frames(break_frame(cloth(), 5, value)).tolist() == [0, 1, 2, 3, 4]


@needs_opengl
def test_positions_that_are_not_finite_are_reported_in_words(
    words: list[str], boxes: Callable[[], tuple[PixelBox, list[PixelBox]]], tmp_path: Path
) -> None:
    draw_run_picture(break_frame(cloth(), 5), tmp_path / "run.png")
    assert "not finite from frame 10 on" in "\n".join(words)
    assert measure_drawn_share(pixels(tmp_path / "run.png"), *boxes()[0]) > 0.01, "the last finite frame is drawn"


@needs_opengl
def test_a_run_without_a_finite_frame_is_a_picture_that_states_it(words: list[str], tmp_path: Path) -> None:
    draw_run_picture(break_frame(cloth(), 0), tmp_path / "run.png")
    assert "not finite from frame 0 on" in "\n".join(words)
    assert pixels(tmp_path / "run.png").shape == (PAGE_HEIGHT, PAGE_WIDTH, 3)


@needs_opengl
def test_a_comparison_shows_solvers_side_by_side_with_their_distance(words: list[str], tmp_path: Path) -> None:
    first = cloth()
    moved = first.positions + np.array([0.0, 0.0, 0.1], np.float32)
    second = replace(first, positions=moved, properties={**first.properties, "solver": "dense"})
    third = replace(break_frame(first, 4), properties={**first.properties, "solver": "xpbd"})
    draw_comparison_picture({"a": first, "b": second, "c": third}, tmp_path / "side.png")
    for said in ("cloth, size 6", "sparse", "dense", "xpbd", "reference", "1.0e-06", "not finite\nfrom frame 8 on"):
        assert said in words
    assert "0.5" in words, "0.1 m are half a rest length of 0.2 m"
    image = pixels(tmp_path / "side.png")
    assert image.shape[1:] == (PAGE_WIDTH, 3)
    assert measure_drawn_share(image, 40, 118, 480, image.shape[0] - 118) > 0.01
    assert measure_drawn_share(image, 540, 118, 480, image.shape[0] - 118) > 0.01
    assert measure_drawn_share(image, 0, image.shape[0] - 60, PAGE_WIDTH, 60) > 0.0, "nothing is left empty below"


@needs_opengl
def test_a_comparison_has_a_panel_for_each_scene_and_size(words: list[str], tmp_path: Path) -> None:
    runs = {}
    for scene in ("cloth", "net"):
        for size in (5, 6):
            for label, threads in (("1 thread", 1), ("2 threads", 2)):
                replay = cloth(size, triangles=scene == "cloth")
                known = {"scene": scene, "size": size, "solver": "sparse", "threads": threads}
                runs[f"{label}, {scene} {size}"] = replace(replay, properties=known)
    draw_comparison_picture(runs, tmp_path / "side.png")
    assert [word for word in words if "size" in word] == [
        "cloth, size 5",
        "cloth, size 6",
        "net, size 5",
        "net, size 6",
    ]
    assert "1 thread, net 6" in words, "runs of one solver go by their labels"
