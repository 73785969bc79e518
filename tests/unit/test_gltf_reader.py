"""glTF files: nodes, shared points, all kinds of triangles and lines, and what is refused; legacy VTK surfaces."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from springbench.harness.errors import InputError
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.gltf_reader import read_gltf

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
QUARTER_TURN = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # a quarter turn about z


def gltf(
    corners: list[int] | None, *, mode: int = 4, node: dict[str, Any] | None = None
) -> tuple[dict[str, Any], bytes]:
    """A document with one mesh of the square's points, and its buffer."""
    binary = POINTS.tobytes() + struct.pack(f"<{len(corners or [])}H", *(corners or []))
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}]
    primitive: dict[str, Any] = {"attributes": {"POSITION": 0}, "mode": mode}
    views = [{"buffer": 0, "byteLength": 48}]
    if corners is not None:
        accessors.append({"bufferView": 1, "componentType": 5123, "count": len(corners), "type": "SCALAR"})
        views.append({"buffer": 0, "byteOffset": 48, "byteLength": 2 * len(corners)})
        primitive["indices"] = 1
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"name": "sheet", "primitives": [primitive]}],
        "nodes": [{"mesh": 0} | (node or {})],
        "scenes": [{"nodes": [0]}],
    }
    return document, binary


def write(path: Path, document: dict[str, Any], binary: bytes) -> Path:
    """A file by its suffix: `.glb` with its buffer, `.gltf` with the buffer as text."""
    if path.suffix == ".gltf":
        document["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
        path.write_text(json.dumps(document))
        return path
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


@pytest.mark.parametrize("name", ["mesh.glb", "mesh.gltf"])
@pytest.mark.parametrize(
    ("corners", "mode", "triangles"),
    [
        ([0, 1, 2, 0, 2, 3], 4, [[0, 1, 2], [0, 2, 3]]),
        ([1, 2, 0, 3], 5, [[1, 2, 0], [2, 3, 0]]),
        ([0, 1, 2, 3], 6, [[0, 1, 2], [0, 2, 3]]),
        (None, 6, [[0, 1, 2], [0, 2, 3]]),
    ],
    ids=["triangles", "strip", "fan", "without indices"],
)
def test_triangles_of_all_kinds_are_read(tmp_path, name, corners, mode, triangles):
    mesh = FileMesh(path=write(tmp_path / name, *gltf(corners, mode=mode))).build_mesh()
    assert mesh.rest_positions.tolist() == POINTS.tolist()
    turned = sorted(np.roll(t, -int(np.argmin(t))).tolist() for t in mesh.triangles)
    assert turned == sorted(np.roll(t, -int(np.argmin(t))).tolist() for t in triangles)
    assert mesh.parts["sheet"].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("mode", "count"), [(1, 2), (2, 4), (3, 3)], ids=["pairs", "loop", "strip"])
def test_lines_are_springs(tmp_path, mode, count):
    mesh = FileMesh(path=write(tmp_path / "mesh.glb", *gltf([0, 1, 2, 3], mode=mode))).build_mesh()
    assert len(mesh.springs) == count


def test_nodes_place_and_mirror_their_meshes(tmp_path):
    document, binary = gltf(
        [0, 1, 2], node={"rotation": QUARTER_TURN, "scale": [2, 1, 1], "translation": [5, 0, 0], "name": "a"}
    )
    mirror = np.diag([1.0, 1.0, -1.0, 1.0])
    document["nodes"] += [{"children": [2], "matrix": mirror.T.ravel().tolist()}, {"mesh": 0, "translation": [0, 0, 1]}]
    document["scenes"][0]["nodes"] = [0, 1]
    mesh = FileMesh(path=write(tmp_path / "mesh.glb", document, binary), unused="drop").build_mesh()
    assert mesh.rest_positions[:3] == pytest.approx(np.array([[5, 0, 0], [5, 2, 0], [4, 2, 0]]), abs=1e-12)
    assert mesh.rest_positions[3:].tolist() == [[0, 0, -1], [1, 0, -1], [1, 1, -1]]
    a, b, c = (mesh.rest_positions[mesh.triangles[:, k]] for k in range(3))
    assert np.sign(np.cross(b - a, c - a)[:, 2]).tolist() == [1, -1]  # a mirror turns the outside with it
    assert mesh.parts["a"].tolist() == [0, 1, 2]


def test_normalised_integers_are_between_minus_one_and_one(tmp_path):
    document, _ = gltf(None)
    points = np.array([[-128, 0, 0], [-127, 0, 0], [127, 0, 0], [0, 127, 0]], np.int8).tobytes()
    document["accessors"][0] |= {"componentType": 5120, "normalized": True}
    document["bufferViews"][0]["byteLength"] = document["buffers"][0]["byteLength"] = len(points)
    read = read_gltf(write(tmp_path / "mesh.glb", document, points))
    assert read.points.tolist() == [[-1, 0, 0], [-1, 0, 0], [1, 0, 0], [0, 1, 0]]


def test_primitives_share_their_points(tmp_path):
    document, binary = gltf([0, 1, 2, 0, 2, 3])
    first = document["meshes"][0]["primitives"][0]
    document["accessors"] += [document["accessors"][1] | {"count": 3, "byteOffset": 6}]
    document["accessors"][1]["count"] = 3
    document["meshes"][0]["primitives"].append(first | {"indices": 2})
    mesh = FileMesh(path=write(tmp_path / "mesh.glb", document, binary)).build_mesh()
    assert len(mesh.rest_positions) == 4
    assert len(mesh.springs) == 5


def change(document: dict[str, Any], case: str) -> None:
    """Break a document in one of the ways of the test below."""
    accessor, primitive = document["accessors"][0], document["meshes"][0]["primitives"][0]
    if case == "version":
        document["asset"]["version"] = "1.0"
    elif case == "draco":
        primitive["extensions"] = {"KHR_draco_mesh_compression": {}}
    elif case == "sparse":
        accessor["sparse"] = {}
    elif case == "cut":
        accessor["count"] = 400
    elif case == "missing":
        document["buffers"][0] = {"byteLength": 4, "uri": "other%20file.bin"}
    elif case == "outside":
        document["buffers"][0] = {"byteLength": 4, "uri": "../../../../../../../../etc/passwd"}
    else:
        document["nodes"][0]["children"] = [0]


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("version", "it is glTF 1.0"),
        ("draco", "compressed by Draco"),
        ("sparse", "sparse data"),
        ("cut", "data end beyond the buffer"),
        ("missing", "not in its folder"),
        ("outside", "outside of its folder"),
        ("circle", "nodes contain each other"),
    ],
)
def test_what_cannot_be_read_is_refused_with_the_reason(tmp_path, case, words):
    document, binary = gltf([0, 1, 2])
    change(document, case)
    with pytest.raises(InputError, match=words):
        FileMesh(path=write(tmp_path / "mesh.glb", document, binary)).build_mesh()


def test_a_cut_file_and_an_index_beyond_the_points_are_refused(tmp_path):
    path = write(tmp_path / "mesh.glb", *gltf([0, 1, 2]))
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError, match="the file was cut"):
        FileMesh(path=path).build_mesh()
    with pytest.raises(InputError, match="names the point 9 of 4"):
        FileMesh(path=write(path, *gltf([0, 1, 9]))).build_mesh()


def test_a_legacy_vtk_file_of_surfaces_is_read(tmp_path):
    path = tmp_path / "mesh.vtk"
    text = "# vtk DataFile Version 3.0\nby hand\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n0 0 0 1 0 0 1 1 0 0 1 0\n"
    path.write_text(
        f"{text}POLYGONS 1 5\n4 0 1 2 3\nPOINT_DATA 4\nSCALARS heat double 1\nLOOKUP_TABLE default\n1 2 3 4\n"
    )
    mesh = FileMesh(path=path).build_mesh()
    assert mesh.springs.tolist() == [[0, 1], [0, 3], [1, 2], [2, 3]]
    assert mesh.attributes["heat"].tolist() == [1, 2, 3, 4]
    path.write_text(text.replace("POINTS 4", "POINTS 400"))
    with pytest.raises(InputError, match="cannot be read as a mesh"):
        FileMesh(path=path).build_mesh()


def test_a_colour_that_is_no_number_is_black(tmp_path):
    path = tmp_path / "mesh.obj"
    path.write_text("v 0 0 0 nan nan nan\nv 1 0 0 1 1 1\nv 0 1 0 0 0 0\nf 1 2 3\n")
    assert FileMesh(path=path).build_mesh().attributes["red"].tolist() == [0, 1, 0]
