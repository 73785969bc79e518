"""`springbench inspect` and `springbench view`: what they print, write, open and refuse."""

from __future__ import annotations

import io
import os
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv
import pytest
import pyvista as pv
from rich.console import Console
from springbench.harness.errors import InputError, RunFailed
from springbench.harness.recording.recording_reader import open_recording_source, read_cell, read_replay
from springbench.harness.recording.side_by_side import LineStyle, write_side_by_side
from springbench.harness.report import recording_inspection as module
from springbench.harness.report.recording_inspection import find_recordings, inspect_recordings, view_recordings
from springbench.harness.scenes.mesh.file_mesh import FileMesh

from tests.synthetic_recordings import MESHES_BY_KIND, build_recording_info, generate_waves, write_recording


@pytest.fixture
def cloth(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "cloth.rrd")


@pytest.fixture
def chain(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "chain.rrd", build_recording_info("chain"))


def print_inspection(*paths: Path, **options: Any) -> str:
    """What an inspection prints, white space made one blank."""
    out = io.StringIO()
    settings = {"frame": None, "export": None, "csv": None, **options}
    inspect_recordings(list(paths), **settings, console=Console(file=out, width=200))
    return " ".join(out.getvalue().split())


def test_an_inspection_states_the_contents_of_a_recording(cloth: Path):
    text = print_inspection(cloth)
    for words in (
        "cloth - test",
        "cpu a, b [c]",
        "frame 0 11",
        "iteration 0 3",
        "frames 12 recorded",
        "/milliseconds/step 1 6 10.5",
        "/energy/springs 2 22 22",
        "/residual 0.1 1e-11 0.1",
        "/max_strain",
        "/scene/mesh",
    ):
        assert words in text, words
    assert "Not complete" not in text


def test_an_inspection_reports_that_a_run_was_stopped(cloth: Path):
    os.truncate(cloth, int(0.7 * cloth.stat().st_size))
    assert "Not complete" in print_inspection(cloth)


@pytest.mark.parametrize("suffix", [".vtp", ".vtk", ".ply", ".stl", ".obj"])
def test_a_frame_is_exported_as_a_surface(suffix: str, cloth: Path, tmp_path: Path):
    target = tmp_path / f"mesh{suffix}"
    print_inspection(cloth, frame=5, export=target)
    replay = read_replay(cloth, [5])
    mesh = pv.read(target)
    assert mesh.n_cells == len(replay.triangles)
    low, high = replay.positions[0].min(axis=0), replay.positions[0].max(axis=0)
    np.testing.assert_allclose(np.reshape(mesh.bounds, (3, 2)).T, [low, high], atol=1e-5)  # text formats: 6 digits
    if suffix in (".vtp", ".vtk"):
        np.testing.assert_array_equal(mesh.points, replay.positions[0])
        assert np.abs(mesh.point_data["strain"]).max() == pytest.approx(replay.scalars["/max_strain"][1][5], rel=1e-4)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl", ".vtk", ".vtp"])
def test_a_frame_far_from_zero_is_exported_in_double_precision_or_not_at_all(suffix: str, tmp_path: Path):
    mesh = MESHES_BY_KIND["cloth"]
    of = replace(
        build_recording_info(), mesh=replace(mesh, rest_positions=mesh.rest_positions + np.array([32e6, 0.0, 0.0]))
    )
    path, target = write_recording(tmp_path / "a.rrd", of, frame_count=3), tmp_path / f"mesh{suffix}"
    if suffix in (".ply", ".stl"):
        with pytest.raises(InputError, match=r"moves vertices by up to 1 m this far .* export to \.vtp"):
            print_inspection(path, export=target)
        assert not target.exists()
    else:
        print_inspection(path, export=target)
        expected = [*generate_waves(of, 3)][-1].positions
        np.testing.assert_allclose(pv.read(target).points, expected, rtol=0, atol=1e-5)  # .obj: text


def test_what_is_exported_is_read_as_a_mesh(cloth: Path, chain: Path, tmp_path: Path):
    for recording in (cloth, chain):
        print_inspection(recording, export=tmp_path / "mesh.vtp")
        mesh, replay = FileMesh(path=tmp_path / "mesh.vtp").build_mesh(), read_replay(recording, [-1])
        np.testing.assert_array_equal(mesh.rest_positions, replay.positions[0])
        np.testing.assert_array_equal(mesh.triangles, replay.triangles)
        if not len(replay.triangles):
            np.testing.assert_array_equal(mesh.springs, replay.springs)


def test_the_last_frame_of_a_chain_is_exported_as_lines(chain: Path, tmp_path: Path):
    print_inspection(chain, export=tmp_path / "chain.vtp")
    mesh, replay = pv.read(tmp_path / "chain.vtp"), read_replay(chain, [-1])
    np.testing.assert_array_equal(mesh.points, replay.positions[0])
    np.testing.assert_array_equal(mesh.lines.reshape(-1, 3)[:, 1:], replay.springs)
    assert mesh.cell_data["strain"].shape == (len(replay.springs),)


def test_scalars_are_written_in_long_form(cloth: Path, tmp_path: Path):
    print_inspection(cloth, csv=tmp_path / "scalars.csv")
    rows = pyarrow.csv.read_csv(tmp_path / "scalars.csv").to_pylist()
    at = {(row["entity"], row["frame"], row["iteration"]): (row["time"], row["value"]) for row in rows}
    assert at["/energy/springs", 4, None] == (0.04, 8.0)
    assert at["/convergence/objective", 3, 2] == (0.03, 4.0)


def test_two_recordings_are_compared_in_metres_and_rest_lengths(cloth: Path, tmp_path: Path):
    of = build_recording_info()
    moved = replace(of.mesh, rest_positions=of.mesh.rest_positions + np.array([0.0, 0.25, 0.0]))
    other = write_recording(tmp_path / "other.rrd", replace(of, mesh=moved), frame_count=9)
    text = print_inspection(cloth, other)
    assert "positions in frame 8" in text  # the last that both have
    shift = np.linalg.norm(
        read_replay(cloth, [8]).positions[0].astype(float) - read_replay(other, [8]).positions[0], axis=1
    )
    spacing = of.rest_lengths.mean()
    assert f"max {shift.max():.6g} {shift.max() / spacing:.6g}" in text
    assert f"rms {np.sqrt(np.mean(shift**2)):.6g}" in text
    assert "/milliseconds/step 6 4.5 0.75" in text


def test_two_equal_recordings_do_not_differ(cloth: Path, tmp_path: Path):
    assert "max 0 0 rms 0 0" in print_inspection(cloth, write_recording(tmp_path / "same.rrd"))


def test_recordings_side_by_side_have_the_longest_scale(tmp_path: Path):
    short, long = build_recording_info("chain", strain_range=0.02), build_recording_info("chain", strain_range=0.4)
    paths = {"a": write_recording(tmp_path / "a.rrd", short), "b": write_recording(tmp_path / "b.rrd", long)}
    write_side_by_side(tmp_path / "both.rrd", paths, "chain 9", dict.fromkeys(paths, LineStyle("#0072b2")))
    seen: dict[str, list[Any]] = {}
    with open_recording_source(tmp_path / "both.rrd") as source:
        for chunk in source.iterate_chunks(content="/**", components=["Points3D:colors", "LineStrips3D:colors"]):
            batch = chunk.to_record_batch()
            for name in {"Points3D:colors", "LineStrips3D:colors"} & set(batch.schema.names):
                rows = [read_cell(batch, name, k).tolist() for k in range(batch.num_rows)]
                seen.setdefault(chunk.entity_path, []).extend(rows)
    for part in ("mesh", "springs"):
        assert seen[f"/1-a/scene/{part}"] == seen[f"/2-b/scene/{part}"], "the same positions have the same colours"


def test_recordings_side_by_side_can_be_inspected(cloth: Path, tmp_path: Path):
    both = tmp_path / "both.rrd"
    paths = {"dense": cloth, "sparse": cloth}
    write_side_by_side(both, paths, "cloth 6", dict.fromkeys(paths, LineStyle("#0072b2")))
    assert "/1-dense/milliseconds/step 1 6 10.5" in print_inspection(both)
    with pytest.raises(InputError, match="not of one run"):
        print_inspection(both, cloth)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frame": 12, "export": Path("a.vtp")}, "no frame 12; frames 0 to 11"),
        ({"frame": 3}, "--frame: .* --export"),
        ({"export": Path("a.png")}, r"unknown suffix '.png'; .* one of .obj, .ply, .stl, .vtk, .vtp"),
        ({"export": Path("no/folder/a.vtp")}, "cannot be written"),
        ({"csv": Path("no/folder/a.csv")}, "cannot be written"),
    ],
    ids=["frame", "frame-without-export", "suffix", "export-folder", "csv-folder"],
)
def test_a_mistake_is_reported_with_the_expected_options(options: dict, message: str, cloth: Path, tmp_path: Path):
    placed = {key: tmp_path / value if isinstance(value, Path) else value for key, value in options.items()}
    with pytest.raises(InputError, match=message):
        print_inspection(cloth, **placed)


def test_a_chain_is_not_exported_as_a_surface(chain: Path, tmp_path: Path):
    with pytest.raises(InputError, match=r"springs without a surface: one of .vtk, .vtp"):
        print_inspection(chain, export=tmp_path / "a.stl")


def test_one_file_takes_one_recording(cloth: Path, chain: Path, tmp_path: Path):
    with pytest.raises(InputError, match="take one recording, not 2"):
        print_inspection(cloth, chain, csv=tmp_path / "a.csv")


def test_meshes_of_different_sizes_are_not_compared(cloth: Path, chain: Path):
    with pytest.raises(InputError, match="36 and 9 vertices"):
        print_inspection(cloth, chain)


def test_the_viewer_opens_the_recordings(cloth: Path, monkeypatch: pytest.MonkeyPatch):
    opened: list[list[str]] = []

    def run(command: list[str], check: bool) -> subprocess.CompletedProcess:
        opened.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(module.subprocess, "run", run)
    view_recordings([cloth])
    ((binary, *files),) = opened
    assert Path(binary).is_file()
    assert files == [str(cloth)]


def test_the_viewer_reports_that_it_needs_a_display(cloth: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(module.sys, "platform", "linux")
    with pytest.raises(RunFailed, match="no display"):
        view_recordings([cloth])


def test_the_viewer_refuses_what_is_no_recording(tmp_path: Path):
    (tmp_path / "a.rrd").write_text("no")
    with pytest.raises(InputError, match="is not a Rerun recording"):
        view_recordings([tmp_path / "a.rrd"])


def test_a_folder_stands_for_the_recordings_below_it(cloth: Path, chain: Path):
    assert find_recordings([cloth.parent]) == [chain, cloth]
    for count, words in ((0, "no Rerun recording"), (60, "60 recordings")):
        folder = cloth.parent / str(count)
        folder.mkdir()
        for number in range(count):
            (folder / f"{number}.rrd").touch()
        with pytest.raises(InputError, match=words):
            find_recordings([folder])
