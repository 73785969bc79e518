"""Reader of STL files, text or binary.

Corners of triangles in one place become one vertex; vertices are numbered in the order of their appearance. Binary
files may begin with `solid` too; their size, and the absence of the words of a text file, distinguish them. Bytes after
the declared triangles are ignored.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

HEAD_BYTES, TRIANGLE_BYTES = 84, 50
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"^\s*vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.M | re.I)
_SOLID, _END = re.compile(rb"^\s*solid\b", re.M | re.I), re.compile(rb"^\s*endsolid\b", re.M | re.I)
_FACET = re.compile(rb"^\s*(?:facet|endsolid)\b", re.M | re.I)


def read_stl(content: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read the points (n, 3) and triangles (f, 3) of an STL file.

    Raises:
        ValueError: for a truncated file, one without triangles, and words in place of numbers.
    """
    if problem := find_cut_stl(content):
        raise ValueError(f"{problem}; the file was cut")
    if _is_text(content):
        words = _VERTEX.findall(content)
        if len(words) % 3:
            raise ValueError(f"it has {len(words)} vertices; expected three for each triangle")
        corners = np.array([[float(word) for word in row] for row in words], np.float64).reshape(-1, 3)
    else:
        count = _count_declared(content)
        triangles = np.frombuffer(content, _TRIANGLE, count, HEAD_BYTES) if count else np.empty(0, _TRIANGLE)
        corners = triangles["corners"].reshape(-1, 3)
    if not len(corners):
        raise ValueError("it has no triangles")
    _, first, label = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))
    return corners[first[order]].astype(np.float64), number[label.ravel()].reshape(-1, 3)


def find_cut_stl(content: bytes) -> str:
    """Describe what a truncated STL file lacks; empty for a complete one."""
    if _is_text(content):
        return "it has no endsolid" if len(_END.findall(content)) < len(_SOLID.findall(content)) else ""
    declared = _count_declared(content)
    found = max(0, len(content) - HEAD_BYTES) // TRIANGLE_BYTES
    return f"its head declares {declared:,} triangles, and {found:,} follow" if found < declared else ""


def _is_text(content: bytes) -> bool:
    has_size = len(content) == HEAD_BYTES + TRIANGLE_BYTES * _count_declared(content)
    return bool(_SOLID.match(content)) and not has_size and bool(_FACET.search(content))


def _count_declared(content: bytes) -> int:
    return int.from_bytes(content[HEAD_BYTES - 4 : HEAD_BYTES], "little")
