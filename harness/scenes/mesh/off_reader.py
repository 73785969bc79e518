"""Reader of OFF files in text (Geomview): points and polygons.

Each point and each face is on its own line. The word OFF may have the prefixes ST, C and N, and may be absent. Colours,
normals and texture coordinates are ignored.
"""

from __future__ import annotations

import re

import numpy as np
from springbench.harness.scenes.mesh.ply_reader import PolygonContent, group_by_corner_count

_KEYWORD = re.compile(rb"(ST)?C?N?(4?n?)OFF")


def read_off(content: bytes) -> PolygonContent:
    """Read the contents of an OFF file; raise ValueError for a broken one."""
    lines = [(k, line.partition(b"#")[0].split()) for k, line in enumerate(content.splitlines(), 1)]
    numbers, rows = [k for k, words in lines if words], [words for _, words in lines if words]
    if rows and (keyword := _KEYWORD.fullmatch(rows[0][0])):
        if keyword[2] or rows[0][1:2] == [b"BINARY"]:
            raise ValueError("it is a binary OFF file, or one of four dimensions; save it as text in three")
        rows[0] = rows[0][1:]
        if not rows[0]:
            rows, numbers = rows[1:], numbers[1:]
    if not rows or not all(word.isdigit() for word in rows[0]) or len(rows[0]) < 2:
        raise ValueError("it does not begin with OFF and the numbers of vertices and faces")
    n, f = int(rows[0][0]), int(rows[0][1])
    if len(rows) <= n + f:
        what = f"its head declares {n:,} vertices and {f:,} faces, and {len(rows) - 1:,} lines follow"
        raise ValueError(f"{what}; the file was cut")
    points = np.array([[float(word) for word in row[:3]] for row in rows[1 : n + 1]], np.float64)
    faces = [[float(word) for word in row[1 : 1 + int(row[0])]] for row in rows[n + 1 : n + f + 1]]
    for k, (face, row) in enumerate(zip(faces, rows[n + 1 :], strict=False)):
        if len(face) < int(row[0]):
            raise ValueError(f"line {numbers[n + 1 + k]} has fewer corners than its first number; the file was cut")
    first = numbers[n + 1] if f and numbers[n + f] - numbers[n + 1] == f - 1 else 0
    return PolygonContent(points, {}, group_by_corner_count([np.array(face) for face in faces]), first)
