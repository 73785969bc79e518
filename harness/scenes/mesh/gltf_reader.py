# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# JSON and YAML have no types.
"""Reader of the geometry of glTF 2.0 files (`.gltf`, `.glb`): triangles and lines of the default scene.

The specification is https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html (Khronos). Positions are transformed to
the scene by the nodes. Materials, skins, morph targets and animations are skipped. Compressed and sparse data are
rejected.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

_COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COMPONENTS_PER_ELEMENT = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
_MAX_NODE_DEPTH = 1_000


class GltfContent(NamedTuple):
    """Contents of a glTF file.

    Attributes:
        points: (n, 3) [m], y up.
        triangles: (f, 3).
        segments: (s, 2).
        vertex_groups: points of each named node, or of its mesh.
    """

    points: FloatArray
    triangles: IndexArray
    segments: IndexArray
    vertex_groups: dict[str, IndexArray]


def read_gltf(path: Path) -> GltfContent:
    """Read a glTF file and the buffers in its folder.

    Raises:
        ValueError: if the file is broken; some faults raise other exceptions of the standard library.
    """
    document, binary = _split_container(path.read_bytes())
    version = str(document.get("asset", {}).get("version", "2.0"))
    if not version.startswith("2"):
        raise ValueError(f"it is glTF {version}; expected version 2")
    return _GltfScene(document, _read_buffers(document, binary, path.parent)).collect_geometry()


def _split_container(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON of a file, and the binary chunk of a `.glb`, or nothing."""
    if content[:4] != b"glTF":
        return json.loads(content.decode("utf-8-sig")), b""
    _, _, length = struct.unpack_from("<4sII", content)
    if length > len(content):
        raise ValueError(f"its head declares {length:,} bytes, and {len(content):,} are there; the file was cut")
    chunks, at = dict[int, bytes](), 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", content, at)
        chunks.setdefault(kind, content[at + 8 : at + 8 + size])
        at += 8 + size
    if _JSON_CHUNK not in chunks:
        raise ValueError("it has no chunk of JSON")
    return json.loads(chunks[_JSON_CHUNK].decode("utf-8")), chunks.get(_BINARY_CHUNK, b"")


def _read_buffers(document: dict[str, Any], binary: bytes, folder: Path) -> list[bytes]:
    return [_read_buffer(buffer, binary, folder) for buffer in document.get("buffers", [])]


def _read_buffer(buffer: dict[str, Any], binary: bytes, folder: Path) -> bytes:
    uri = buffer.get("uri")
    if uri is None:
        content = binary
    elif uri.startswith("data:"):
        try:
            content = base64.b64decode(uri.partition(",")[2], validate=True)
        except binascii.Error as error:
            raise ValueError(f"a buffer is no base64 ({error})") from None
    else:
        file = folder / unquote(uri)
        if not file.is_file():
            raise ValueError(f"its buffer {uri[:80]!r} is not in its folder; move the files together")
        content = file.read_bytes()
    if len(content) < buffer["byteLength"]:
        raise ValueError(f"a buffer declares {buffer['byteLength']:,} bytes, and {len(content):,} are there")
    return content


class _GltfScene:
    """Geometry of the nodes of a scene, collected in their order."""

    def __init__(self, document: dict[str, Any], buffers: list[bytes]) -> None:
        self._document, self._buffers = document, buffers
        self._points, self._num_points = list[FloatArray](), 0
        self._triangles, self._segments = list[IndexArray](), list[IndexArray]()
        self._groups: dict[str, list[IndexArray]] = {}

    def collect_geometry(self) -> GltfContent:
        """Return the geometry of all nodes."""
        for node, transform in self._list_nodes():
            if "mesh" in node:
                self._add_mesh(node, transform)
        return GltfContent(
            np.concatenate([np.empty((0, 3)), *self._points]),
            np.concatenate([np.empty((0, 3), np.int64), *self._triangles]),
            np.concatenate([np.empty((0, 2), np.int64), *self._segments]),
            {name: np.concatenate(some) for name, some in self._groups.items()},
        )

    def _list_nodes(self) -> Iterator[tuple[dict[str, Any], FloatArray]]:
        """Yield the nodes of the default scene with their transforms (4, 4)."""
        nodes, scenes = self._document.get("nodes", []), self._document.get("scenes")
        roots = scenes[self._document.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
        left = [(index, np.eye(4), 0) for index in reversed(roots)]
        while left:
            index, parent, depth = left.pop()
            if depth > _MAX_NODE_DEPTH:
                raise ValueError("its nodes contain each other")
            transform = parent @ _read_transform(nodes[index])
            yield nodes[index], transform
            left += [(child, transform, depth + 1) for child in reversed(nodes[index].get("children", []))]

    def _add_mesh(self, node: dict[str, Any], transform: FloatArray) -> None:
        mesh = self._document["meshes"][node["mesh"]]
        first_points, used = dict[int, int](), list[IndexArray]()  # primitives of a mesh may share their points
        flips = np.linalg.det(transform[:3, :3]) < 0.0
        for primitive in mesh["primitives"]:
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise ValueError("it is compressed by Draco; save it without compression")
            accessor = primitive["attributes"]["POSITION"]
            if accessor not in first_points:
                points = self._read_accessor(accessor).astype(np.float64).reshape(-1, 3)
                first_points[accessor] = self._num_points
                self._points.append(points @ transform[:3, :3].T + transform[:3, 3])
                self._num_points += len(points)
            count = self._document["accessors"][accessor]["count"]
            corners = np.arange(count)
            if "indices" in primitive:
                corners = self._read_accessor(primitive["indices"]).astype(np.int64).ravel()
                if len(corners) and corners.max() >= count:
                    raise ValueError(f"a face names the point {corners.max()} of {count}")
            cells = _split_primitive(corners + first_points[accessor], primitive.get("mode", 4))
            if cells.shape[1] == 3:
                self._triangles.append(cells[:, ::-1] if flips else cells)
            elif cells.shape[1] == 2:
                self._segments.append(cells)
            used.append(cells.ravel())
        name = str(node.get("name") or mesh.get("name") or "")
        if name:
            self._groups.setdefault(name, []).append(np.unique(np.concatenate(used)))

    def _read_accessor(self, index: int) -> NDArray[Any]:
        """Return the elements of an accessor, (count, components)."""
        accessor = self._document["accessors"][index]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("it has sparse data; save it without")
        view, dtype = self._document["bufferViews"][accessor["bufferView"]], _COMPONENT_TYPES[accessor["componentType"]]
        if "EXT_meshopt_compression" in view.get("extensions", {}):
            raise ValueError("it is compressed by meshopt; save it without compression")
        width, count = _COMPONENTS_PER_ELEMENT[accessor["type"]], int(accessor["count"])
        item = np.dtype(dtype).itemsize
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", width * item)
        buffer = self._buffers[view["buffer"]]
        if min(start, count, stride) < 0 or (count and start + (count - 1) * stride + width * item > len(buffer)):
            raise ValueError("its data end beyond the buffer; the file was cut")
        found = np.ndarray((count, width), dtype, buffer, start, (stride, item))
        if not accessor.get("normalized") or found.dtype.kind == "f":
            return found
        return np.maximum(found / np.iinfo(np.dtype(dtype)).max, -1.0)  # a signed integer has one more negative value


def _read_transform(node: dict[str, Any]) -> FloatArray:
    """Return the transform (4, 4) of a node, from its matrix or from scale, rotation and translation."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    transform = np.eye(4)
    transform[:3, :3] = rotation * np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    transform[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return transform


def _split_primitive(corners: IndexArray, mode: int) -> IndexArray:
    """Split the corners of a primitive into triangles (f, 3), lines (s, 2), or points (n, 1).

    Modes of glTF: 0 points, 1 lines, 2 line loop, 3 line strip, 4 triangles, 5 triangle strip, 6 triangle fan.
    """
    if mode == 4:
        return corners[: len(corners) // 3 * 3].reshape(-1, 3)
    if mode == 5:
        strip = np.column_stack([corners[:-2], corners[1:-1], corners[2:]])
        strip[1::2, 1:] = strip[1::2, :0:-1]  # every second triangle has the opposite orientation
        return strip
    if mode == 6:
        return np.column_stack([np.full(max(len(corners) - 2, 0), corners[0]), corners[1:-1], corners[2:]])
    if mode in (2, 3):
        ends = np.roll(corners, -1) if mode == 2 else corners[1:]
        return np.column_stack([corners[: len(ends)], ends])
    return corners[: len(corners) // 2 * 2].reshape(-1, 2) if mode == 1 else corners[:, None]
