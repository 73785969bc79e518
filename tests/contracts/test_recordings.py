"""Properties of every recording: exact positions, small files, whole files or none, and answers for damaged ones."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader
from springbench.harness.atomic_files import WriteError
from springbench.harness.errors import InputError
from springbench.harness.recording.recorder_interface import LAYOUT_VERSION, RecordedFrame
from springbench.harness.recording.recording_reader import (
    open_recording_source,
    read_cell,
    read_replay,
    summarise_recording,
)
from springbench.harness.recording.rerun_recorder import FLUSH_INTERVAL, RerunRecorder
from springbench.harness.recording.side_by_side import LineStyle, read_residuals, write_side_by_side
from springbench.harness.recording.strain_scale import NUM_LEVELS, build_palette
from springbench.harness.scenes.mesh.grid_mesh import GridMesh

from tests.synthetic_recordings import (
    MESHES_BY_KIND,
    build_recording_info,
    generate_waves,
    write_foreign_recording,
    write_recording,
)


def columns(path: Path) -> dict[tuple[str, str], str]:
    """A digest of each column of a recording, decoded: row ids and the cut into chunks do not count."""
    rows: dict[tuple[str, str], list[tuple[str, bytes]]] = {}
    for chunk in RrdReader(path).store().stream():
        batch = chunk.to_record_batch()
        times = [batch[name].cast(pa.int64()).to_pylist() for name in sorted(chunk.timeline_names)]
        for name in set(batch.schema.names) - set(chunk.timeline_names) - {"rerun.controls.RowId"}:
            for k in range(batch.num_rows):
                digest = hashlib.sha256(repr(batch[name][k].as_py()).encode()).digest()
                rows.setdefault((chunk.entity_path, name), []).append((repr([t[k] for t in times]), digest))
    return {key: hashlib.sha256(repr(sorted(found)).encode()).hexdigest() for key, found in rows.items()}


@pytest.mark.parametrize("mesh", MESHES_BY_KIND)
def test_positions_come_back_exactly_to_float32(mesh: str, tmp_path: Path):
    of = build_recording_info(mesh)
    replay = read_replay(write_recording(tmp_path / "a.rrd", of, frame_count=12))
    expected = np.array([frame.positions.astype(np.float32) for frame in generate_waves(of, 12)])
    np.testing.assert_array_equal(replay.positions, expected)
    np.testing.assert_array_equal(replay.frames, np.arange(12))
    np.testing.assert_allclose(replay.times, 0.01 * np.arange(12), atol=1e-9)  # the file counts nanoseconds


@pytest.mark.parametrize(("mesh", "component"), [("cloth", "Mesh3D:vertex_colors"), ("chain", "Points3D:colors")])
def test_each_frame_has_the_colours_of_its_own_strains(mesh: str, component: str, tmp_path: Path):
    of = build_recording_info(mesh)
    found: dict[Any, Any] = {}
    with open_recording_source(write_recording(tmp_path / "a.rrd", of, frame_count=12)) as source:
        for chunk in source.iterate_chunks(content="/scene/mesh", components=[component]):
            batch = chunk.to_record_batch()
            found |= dict(zip(batch["frame"].to_pylist(), batch[component].to_pylist(), strict=True))
    scale = {int(colour): level for level, colour in enumerate(build_palette().view(">u4").ravel())}
    seen = set()
    for frame in generate_waves(of, 12):
        strain = np.linalg.norm(np.diff(frame.positions[of.springs], axis=1)[:, 0], axis=1) / of.rest_lengths - 1.0
        levels = []
        for v in range(len(frame.positions)):
            near = strain[(of.springs == v).any(axis=1)]
            most = near[np.abs(near).argmax()]
            levels.append(round((float(np.clip(most / of.strain_range, -1, 1)) + 1) * (NUM_LEVELS - 1) / 2))
        recorded = [scale[colour] for colour in found[frame.index]]
        assert np.abs(np.subtract(recorded, levels)).max() <= 1, "a strain may be rounded to either of two levels"
        seen.add(tuple(recorded))
    assert len(seen) == 12, "another frame's colours are others"


@pytest.mark.parametrize("mesh", MESHES_BY_KIND)
def test_what_does_not_change_comes_back(mesh: str, tmp_path: Path):
    of = build_recording_info(mesh)
    replay = read_replay(write_recording(tmp_path / "a.rrd", of))
    assert (replay.title, replay.run_id, replay.strain_range) == (of.title, of.run_id, of.strain_range)
    assert replay.properties == {**of.properties, "prevents_self_intersection": False}
    np.testing.assert_array_equal(replay.triangles, of.mesh.triangles)
    np.testing.assert_array_equal(replay.springs, of.springs)
    np.testing.assert_array_equal(replay.rest_lengths, of.rest_lengths)
    np.testing.assert_array_equal(replay.pinned_vertices, of.pinned_vertices)


def test_a_mesh_without_springs_or_pins_is_recorded(tmp_path: Path):
    none = {
        "springs": np.empty((0, 2), np.int64),
        "rest_lengths": np.empty(0),
        "pinned_vertices": np.empty(0, np.int64),
    }
    replay = read_replay(write_recording(tmp_path / "a.rrd", build_recording_info(**none)))
    assert (replay.springs.shape, replay.rest_lengths.shape, replay.pinned_vertices.shape) == ((0, 2), (0,), (0,))
    assert len(replay.frames) == 12


def test_topology_is_written_once(tmp_path: Path):
    with open_recording_source(write_recording(tmp_path / "a.rrd", frame_count=30)) as source:
        found = list(source.iterate_chunks(content="/scene/mesh", components=["Mesh3D:triangle_indices"]))
    assert [(chunk.num_rows, chunk.is_static) for chunk in found] == [(1, True)]


def test_scalars_come_in_bulk(tmp_path: Path):
    frames = 3 * FLUSH_INTERVAL + 2
    with open_recording_source(write_recording(tmp_path / "a.rrd", frame_count=frames)) as source:
        chunks = list(source.iterate_chunks(content="/max_strain", components=["Scalars:scalars"]))
    assert [chunk.num_rows for chunk in chunks] == [FLUSH_INTERVAL + 1, FLUSH_INTERVAL, FLUSH_INTERVAL, 1]


def test_a_frame_of_a_large_cloth_takes_at_most_20_bytes_a_vertex(tmp_path: Path):
    mesh = GridMesh().build_mesh(64)
    of = replace(build_recording_info(), mesh=mesh, springs=mesh.springs, rest_lengths=mesh.rest_lengths)
    sizes = [write_recording(tmp_path / f"{count}.rrd", of, count, 0.01).stat().st_size for count in (60, 180)]
    assert (sizes[1] - sizes[0]) / 120 / len(mesh.rest_positions) < 20


def test_recording_leaves_its_input_untouched(tmp_path: Path):
    of = build_recording_info()
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    for frame in generate_waves(of, 3):
        before = frame.positions.copy()
        frame.positions.flags.writeable = False  # writing would raise
        recorder.record_frame(frame)
        np.testing.assert_array_equal(frame.positions, before)
    recorder.finish_recording({})


@pytest.mark.parametrize("value", [np.nan, np.inf, -1e300])
def test_positions_that_are_not_finite_are_recorded(value: float, tmp_path: Path):
    of = build_recording_info()
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    for frame in generate_waves(of, 3):
        p = frame.positions.copy()
        if frame.index == 1:
            p[7] = value
        recorder.record_frame(replace(frame, positions=p))
    replay = read_replay(recorder.finish_recording({}))
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(replay.positions[1, 7], np.full(3, np.float32(value)))
    assert np.isfinite(replay.positions[[0, 2]]).all()


def test_two_recordings_of_one_run_are_equal(tmp_path: Path):
    first, second = (columns(write_recording(tmp_path / f"{name}.rrd")) for name in "ab")
    assert first == second
    other = columns(write_recording(tmp_path / "c.rrd", amplitude=0.1 + 1e-6))
    assert first.keys() == other.keys()
    changed = {entity for entity, name in first if first[entity, name] != other[entity, name]}
    assert changed >= {"/scene/mesh", "/max_strain"}


def test_the_scalars_of_a_replay_have_one_value_a_frame(tmp_path: Path):
    scalars = read_replay(write_recording(tmp_path / "a.rrd", frame_count=12)).scalars
    steps = np.arange(1, 12)
    np.testing.assert_array_equal(scalars["/energy/springs"], (steps, 2.0 * steps))
    np.testing.assert_array_equal(scalars["/milliseconds/local"], (steps, steps / 2))
    np.testing.assert_array_equal(scalars["/residual"][1], [np.nan, *(10.0**-k for k in range(1, 12))])
    np.testing.assert_allclose(scalars["/residual/log10"][1][1:], -steps)
    np.testing.assert_array_equal(scalars["/num_iterations"][1], np.arange(12))
    assert not any("convergence" in entity for entity in scalars)


def test_convergence_is_one_entity_by_iteration_with_a_value_for_each_frame(tmp_path: Path):
    recorder = RerunRecorder(tmp_path / "a.rrd", build_recording_info())
    for frame in generate_waves(build_recording_info(), 8):
        recorder.record_frame(frame)
    recorder.record_convergence(3, [1.0, 0.1, 0.0], [5.0, 4.0, 4.0])
    recorder.record_convergence(7, [2.0, 0.2], [3.0, 2.0])
    recorder.record_convergence(4, [], [])  # at rest
    recorder.record_convergence(5, [3.0], [np.nan])  # a method without an objective
    found = summarise_recording(recorder.finish_recording({}))
    rows = [row for row in found.scalars.to_pylist() if row["entity"] == "/convergence/residual"]
    values = {(row["frame"], row["iteration"], row["time"]): row["value"] for row in rows}
    expected = {(3, 1, 0.03): 1.0, (3, 2, 0.03): 0.1, (3, 3, 0.03): 0.0, (7, 1, 0.07): 2.0, (7, 2, 0.07): 0.2}
    expected |= {(5, 1, 0.05): 3.0}
    assert {key: value for key, value in values.items() if not np.isnan(value)} == expected
    entities = [entity for entity in found.entities if "convergence" in entity]
    assert entities == [
        "/convergence",
        *(f"/convergence/{name}" for name in ("objective", "residual")),
    ]
    with open_recording_source(tmp_path / "a.rrd") as source:
        assert read_residuals(source) == {3: [1.0, 0.1, 0.0], 5: [3.0], 7: [2.0, 0.2]}
        curves = list(source.iterate_chunks(content="/curves/residual/lines"))
    assert [chunk.is_static for chunk in curves] == [True], "it is drawn on every timeline"


def test_each_energy_is_seen_by_its_change_and_none_hides_another(tmp_path: Path):
    scalars = read_replay(write_recording(tmp_path / "a.rrd", frame_count=12)).scalars
    for name in ("springs", "inertia"):
        np.testing.assert_allclose(scalars[f"/energy_change/{name}"][1], np.arange(11) / 10)


def test_forces_are_arrows_in_proportion_at_no_more_than_some_vertices(tmp_path: Path):
    mesh = GridMesh().build_mesh(20)
    of = replace(build_recording_info(), mesh=mesh, springs=mesh.springs, rest_lengths=mesh.rest_lengths)
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    for frame in generate_waves(of, 4):
        recorder.record_frame(replace(frame, forces={"external": np.full((400, 3), -1.0 - frame.index % 3)}))
    recorder.finish_recording({})
    found = []
    with open_recording_source(tmp_path / "a.rrd") as source:
        for chunk in source.iterate_chunks(content="/scene/forces/external", components=["Arrows3D:vectors"]):
            batch = chunk.to_record_batch()
            found += [read_cell(batch, "Arrows3D:vectors", k).reshape(-1, 3) for k in range(batch.num_rows)]
    assert [len(vectors) for vectors in found] == [200] * 4
    lengths = [np.linalg.norm(vectors[0]) for vectors in found]
    np.testing.assert_allclose(
        lengths, 0.05 * mesh.bounding_box_diagonal * np.array([1, 2, 3, 1]), rtol=1e-5
    )  # float32


def test_an_arrow_begins_at_its_vertex_and_points_along_its_force(tmp_path: Path):
    of, size = build_recording_info(), build_recording_info().mesh.bounding_box_diagonal
    forces = np.zeros((36, 3))
    forces[3], forces[7] = (0.0, -9.81, 0.0), (3.0, 0.0, 4.0)  # 9.81 N and 5 N; the longest arrow takes .15 of the size
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    (frame,) = generate_waves(of, 1)
    recorder.record_frame(replace(frame, forces={"external": forces}))
    recorder.finish_recording({})
    with open_recording_source(tmp_path / "a.rrd") as source:
        found = [chunk.to_record_batch() for chunk in source.iterate_chunks(content="/scene/forces/external")]
    (batch,) = [one for one in found if "Arrows3D:vectors" in one.schema.names]
    vectors, origins = (read_cell(batch, f"Arrows3D:{name}").reshape(-1, 3) for name in ("vectors", "origins"))
    expected = 0.15 * size * np.array([[0.0, -1.0, 0.0], [0.6 * 5 / 9.81, 0.0, 0.8 * 5 / 9.81]])
    np.testing.assert_allclose(vectors, expected, rtol=1e-6)
    np.testing.assert_allclose(origins, frame.positions[[3, 7]], rtol=1e-6)


def test_a_small_recording_is_small(tmp_path: Path):
    size = write_recording(tmp_path / "a.rrd", frame_count=13).stat().st_size
    assert size < 300_000, "of 36 vertices; the index of what the file holds takes four tenths of it"


def test_a_recording_of_another_layout_is_refused_in_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("springbench.harness.recording.rerun_recorder.LAYOUT_VERSION", LAYOUT_VERSION - 1)
    path = write_recording(tmp_path / "a.rrd")
    with pytest.raises(InputError, match=r"layout of another version .* repeat its run with --rerun"):
        read_replay(path)


def test_springs_of_a_large_mesh_do_not_stay_over_a_mesh_that_moves_on(tmp_path: Path):
    mesh = GridMesh().build_mesh(20)
    of = replace(build_recording_info(), mesh=mesh, springs=mesh.springs, rest_lengths=mesh.rest_lengths)
    drawn, cleared = [], []
    with open_recording_source(write_recording(tmp_path / "a.rrd", of, frame_count=100)) as source:
        for chunk in source.iterate_chunks(content="/scene/springs"):
            batch = chunk.to_record_batch()
            names = set(batch.schema.names)
            for k, frame in enumerate(batch["frame"].to_pylist()):
                if "LineStrips3D:strips" in names and batch["LineStrips3D:strips"][k].is_valid:
                    drawn.append(frame)
                if "Clear:is_recursive" in names and batch["Clear:is_recursive"][k].is_valid:
                    cleared.append(frame)
    assert 1 < len(drawn) < 10
    assert cleared == [frame + 1 for frame in drawn]


def test_the_file_has_its_name_only_when_it_is_complete(tmp_path: Path):
    of = build_recording_info()
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    for frame in generate_waves(of, 7):
        recorder.record_frame(frame)
    assert not (tmp_path / "a.rrd").exists()
    assert recorder.finish_recording({}) == tmp_path / "a.rrd"
    recorder.abandon_recording()  # as a clean-up does: nothing more happens
    assert [file.name for file in tmp_path.iterdir()] == ["a.rrd"]
    assert summarise_recording(tmp_path / "a.rrd").is_complete
    assert RrdReader(tmp_path / "a.rrd").blueprints(), "it opens with its own layout"


def test_nothing_is_left_of_an_abandoned_recording(tmp_path: Path):
    recorder = RerunRecorder(tmp_path / "a.rrd", build_recording_info())
    for frame in generate_waves(build_recording_info(), 7):
        recorder.record_frame(frame)
    recorder.abandon_recording()
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_cannot_be_written_fails(tmp_path: Path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(WriteError, match="cannot be written"):
        RerunRecorder(tmp_path / "file" / "a.rrd", build_recording_info())


def test_chosen_frames_are_read_alone(tmp_path: Path):
    path = write_recording(tmp_path / "a.rrd", frame_count=12)
    whole, chosen = read_replay(path), read_replay(path, [7, 2, -1])
    np.testing.assert_array_equal(chosen.frames, [2, 7, 11])
    np.testing.assert_array_equal(chosen.positions, whole.positions[[2, 7, 11]])
    with pytest.raises(InputError, match="no frame 12; frames 0 to 11"):
        read_replay(path, [12])


def test_solvers_stand_side_by_side_in_one_file(tmp_path: Path):
    paths = {"dense, 5 x": tmp_path / "a.rrd", "dense 5 x": tmp_path / "b.rrd"}
    for k, path in enumerate(paths.values()):
        write_recording(path, amplitude=0.1 * (k + 1))
    write_side_by_side(tmp_path / "both.rrd", paths, "cloth 6", dict.fromkeys(paths, LineStyle("#0072b2")))
    found = summarise_recording(tmp_path / "both.rrd")
    assert found.is_complete
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.rrd", "b.rrd", "both.rrd"]
    for k, path in enumerate(paths.values()):
        root = f"/{k + 1}-dense-5-x"
        assert {root + entity for entity in summarise_recording(path).entities} <= set(found.entities)
        ours = {key: value for key, value in columns(path).items() if key[0] == "/scene/mesh"}
        copied = columns(tmp_path / "both.rrd")
        assert {name: copied[root + entity, name] for entity, name in ours} == {key[1]: v for key, v in ours.items()}


def test_nothing_is_left_of_a_comparison_with_a_stranger(tmp_path: Path):
    write_recording(tmp_path / "a.rrd")
    write_foreign_recording(tmp_path / "b.rrd")
    paths = {name: tmp_path / f"{name}.rrd" for name in "ab"}
    with pytest.raises(InputError, match="not of one run"):
        write_side_by_side(tmp_path / "both.rrd", paths, "both", dict.fromkeys(paths, LineStyle("#0072b2")))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.rrd", "b.rrd"]


def test_frames_may_be_left_out(tmp_path: Path):
    of = build_recording_info()
    recorder = RerunRecorder(tmp_path / "a.rrd", of)
    for index in (0, 10, 20):
        recorder.record_frame(RecordedFrame(index, index * 0.01, of.mesh.rest_positions, {}, 1.0, 1))
    np.testing.assert_array_equal(read_replay(recorder.finish_recording({})).frames, [0, 10, 20])
