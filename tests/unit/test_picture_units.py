"""Pictures of very short runs, very small and very far meshes have readable units and show the mesh."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import springbench
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report.obstacle_meshes import points_to_frame
from springbench.harness.report.page_layout import format_frame_time

FAR = (32_000_000.0, 450.0, -5_300_000.0)
TIMES = {
    "nothing has moved": (0.0, "0.00 s"),
    "seconds": (2.5, "2.50 s"),
    "a frame": (1 / 30, "0.03 s"),
    "milliseconds": (5e-3, "5.00 ms"),
    "microseconds": (2e-5, "20.00 µs"),
    "nanoseconds": (1.5e-8, "15.00 ns"),
    "picoseconds": (2e-12, "2.00 ps"),
    "less than any unit": (1e-30, "0.00 s"),
}


def write_square(path: Path, metres: float, corner: tuple[float, float, float]) -> None:
    """A square of 4 x 4 cells."""
    places = [np.array([i, 0.0, j]) / 4 * metres + corner for j in range(5) for i in range(5)]
    faces = [(a, a + 1, a + 6, a + 5) for j in range(4) for i in range(4) for a in [5 * j + i + 1]]
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in (map(float, p) for p in places)]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c} {d}" for a, b, c, d in faces)]) + "\n")


def capture_replay(
    folder: Path, monkeypatch: pytest.MonkeyPatch, metres: float, corner: tuple[float, float, float]
) -> tuple[springbench.Simulation, RecordingReplay]:
    """A square that hangs from two corners for 3 steps, and what its picture is drawn from."""
    write_square(folder / "square.obj", metres, corner)
    effects = [{"kind": "springs", "stretch": 300.0}, {"kind": "gravity", "acceleration": [0.0, -9.81 * metres, 0.0]}]
    scene = springbench.make_scene(
        mesh={"kind": "file", "path": "square.obj"},
        effects=[*effects, {"kind": "pins", "indices": [0, 4]}],
        folder=folder,
        mass=1.0,
        time_step="1/30",
        frames=3,
    )
    simulation = springbench.Simulation(scene, "newton", rtol=1e-9)
    simulation.run_steps(3)
    drawn = list[RecordingReplay]()
    monkeypatch.setattr("springbench.harness.api.draw_picture", drawn.append)
    simulation.draw_state()
    return simulation, drawn[0]


@pytest.mark.parametrize(("last", "words"), TIMES.values(), ids=TIMES)
def test_a_time_has_a_unit_in_which_it_can_be_read(last: float, words: str):
    found = replace(_empty_replay(), times=np.array([0.0, last]))
    assert format_frame_time(found, 1) == words


def _empty_replay() -> RecordingReplay:
    none = np.zeros((0, 3), np.int64)
    return RecordingReplay(
        *("", "", np.arange(2), np.zeros(2), np.zeros((2, 1, 3), np.float32), none, none[:, :2], np.zeros(0)),
        *(np.zeros(0, np.int64), 0.1, {}, {}),
    )


def test_the_motion_of_a_mesh_does_not_depend_on_where_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    _, near = capture_replay(tmp_path, monkeypatch, 1.0, (0.0, 0.0, 0.0))
    simulation, far = capture_replay(tmp_path, monkeypatch, 1.0, FAR)
    assert far.origin.any()
    assert np.abs(far.positions).max() < 20.0, "relative to an origin near the mesh"
    # Coordinates of 3.2e7 m are rounded to 3.7e-9 m, and single precision near the origin to 1e-6 m.
    assert far.absolute_positions(1) - simulation.positions == pytest.approx(0.0, abs=2e-6)
    assert far.absolute_positions(1) - FAR == pytest.approx(near.absolute_positions(1), abs=1e-5)
    for replay in (near, far):
        assert np.ptp(points_to_frame(replay, [0, 1]), axis=0).max() == pytest.approx(1.0, rel=0.2)


def test_a_mesh_of_a_nanometre_moves_and_is_framed_as_one_of_a_metre(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    _, large = capture_replay(tmp_path, monkeypatch, 1.0, (0.0, 0.0, 0.0))
    _, small = capture_replay(tmp_path, monkeypatch, 1e-9, (0.0, 0.0, 0.0))
    assert 1e9 * small.positions == pytest.approx(large.positions, rel=1e-5, abs=1e-6)
    ratio = np.ptp(points_to_frame(small, [0, 1]), axis=0) / np.ptp(points_to_frame(large, [0, 1]), axis=0)
    assert ratio == pytest.approx(1e-9, rel=1e-5)
