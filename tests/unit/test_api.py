"""What scripts and notebooks use of stored results: rows, recordings, pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import springbench
from springbench.harness.errors import InputError
from springbench.harness.results import parquet_rows

from tests.synthetic_recordings import build_recording_info, generate_waves, write_recording


@pytest.fixture
def drawing_arguments(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """What the functions that draw are given; they write a few bytes instead of a picture."""
    given: list[object] = []

    def draw(what: object, path: Path) -> None:
        given.append(what)
        path.write_bytes(b"a picture")

    monkeypatch.setattr("springbench.harness.report.run_picture.draw_run_picture", draw)
    monkeypatch.setattr("springbench.harness.report.comparison_picture.draw_comparison_picture", draw)
    return given


def test_rows_of_a_folder_are_a_table_in_the_order_of_their_files(tmp_path: Path):
    (tmp_path / "rows").mkdir()
    for name in ("b", "a"):
        parquet_rows.write_rows(tmp_path / "rows" / f"{name}.parquet", [{"solver": name, "frame": k} for k in (1, 2)])
    found = springbench.load_rows(tmp_path)
    assert [*zip(found["solver"], found["frame"], strict=True)] == [(s, k) for s in "ab" for k in (1, 2)]


def test_an_opened_recording_has_every_frame(tmp_path: Path):
    of = build_recording_info("chain")
    replay = springbench.open_recording(write_recording(tmp_path / "a.rrd", of, frame_count=3))
    np.testing.assert_array_equal(replay.positions, [f.positions.astype(np.float32) for f in generate_waves(of, 3)])
    np.testing.assert_array_equal(replay.springs, of.springs)
    with pytest.raises(InputError, match="nowhere"):
        springbench.open_recording(tmp_path / "nowhere.rrd")


def test_a_recording_is_drawn_alone_and_several_side_by_side(tmp_path: Path, drawing_arguments: list[object]):
    path = write_recording(tmp_path / "a.rrd", build_recording_info("chain"), frame_count=2)
    replay = springbench.open_recording(path)
    picture = springbench.draw_picture(replay)
    springbench.draw_picture({"one": path, "other": replay})
    alone, other = drawing_arguments
    assert alone is replay
    assert isinstance(other, dict)
    assert list(other) == ["one", "other"]
    np.testing.assert_array_equal(other["one"].positions, replay.positions)
    assert picture._repr_png_() == picture.save(tmp_path / "a.png").read_bytes() == b"a picture"
