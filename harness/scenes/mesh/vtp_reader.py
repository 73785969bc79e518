"""Reader of VTK's XML files of surfaces and lines (.vtp).

Data arrays are text, base64 or raw, compressed or not. The format is that of
https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html. The reader returns polygons, strips and lines
of all pieces, point data, and the cell data of lines; vertex cells are ignored.
"""

from __future__ import annotations

import base64
import lzma
import re
import zlib
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

_APPENDED_DATA = re.compile(rb'<AppendedData\s+encoding\s*=\s*"(raw|base64)"\s*>\s*_')
_DECOMPRESSORS: dict[str, Callable[[bytes], bytes]] = {
    "vtkZLibDataCompressor": zlib.decompress,
    "vtkLZMADataCompressor": lzma.decompress,
}
_NUMPY_TYPES = {
    "Float32": "f4",
    "Float64": "f8",
    **{f"{sign}{bits}": f"{sign[0].lower()}{bits // 8}" for sign in ("Int", "UInt") for bits in (8, 16, 32, 64)},
}


class VtpContent(NamedTuple):
    """Contents of a .vtp file.

    Attributes:
        points: (n, 3).
        polygons, lines: cells by their points.
        point_attributes: by name, (n,) or (n, k).
        line_attributes: cell data of the lines by name, each (lines,).
    """

    points: FloatArray
    polygons: list[IndexArray]
    lines: list[IndexArray]
    point_attributes: dict[str, FloatArray]
    line_attributes: dict[str, FloatArray]


def read_vtp(content: bytes) -> VtpContent:
    """Read the contents of a .vtp file.

    Raises:
        ValueError: if the file is broken; some faults raise other exceptions of the standard library.
    """
    found = _APPENDED_DATA.search(content)
    if found:
        end = content.rfind(b"</AppendedData>")
        head, appended = content[: found.start()], content[found.end() : end if end >= 0 else None]
        root = ElementTree.fromstring(head + b"</VTKFile>")
        arrays = _DataArrays(root, appended, raw=found[1] == b"raw")
    else:
        root = ElementTree.fromstring(content)
        arrays = _DataArrays(root, b"", raw=False)
    if root.get("type") != "PolyData":
        raise ValueError(f"contains {root.get('type')}; expected PolyData")
    pieces = [_read_piece(piece, arrays) for piece in root.iter("Piece")]
    first = np.cumsum([0, *(len(piece.points) for piece in pieces)]).tolist()
    moved = list(zip(first, pieces, strict=False))
    shared = set[str].intersection(*(set(piece.point_attributes) for piece in pieces)) if pieces else set[str]()
    of_lines = set[str].intersection(*(set(piece.line_attributes) for piece in pieces)) if pieces else set[str]()
    return VtpContent(
        np.concatenate([np.empty((0, 3)), *(piece.points for piece in pieces)]),
        [k + polygon for k, piece in moved for polygon in piece.polygons],
        [k + line for k, piece in moved for line in piece.lines],
        {name: np.concatenate([piece.point_attributes[name] for piece in pieces]) for name in sorted(shared)},
        {name: np.concatenate([piece.line_attributes[name] for piece in pieces]) for name in sorted(of_lines)},
    )


def _read_piece(piece: Element, arrays: _DataArrays) -> VtpContent:
    points = np.empty((0, 3))
    for array in piece.iterfind("Points/DataArray"):
        points = arrays.decode_array(array).reshape(-1, 3).astype(np.float64)
    strips = [strip[[k, k + 1 + k % 2, k + 2 - k % 2]] for strip in _read_cells(piece, "Strips", arrays)
              for k in range(len(strip) - 2)]  # fmt: skip
    numbers: dict[str, FloatArray] = {}
    for array in piece.iterfind("PointData/DataArray"):
        values = arrays.decode_array(array).astype(np.float64)
        if len(points) and len(values) % len(points) == 0:
            numbers[array.get("Name", "")] = values.reshape(len(points), -1)
    polygons, lines = _read_cells(piece, "Polys", arrays), _read_cells(piece, "Lines", arrays)
    return VtpContent(points, polygons + strips, lines, numbers, _read_line_attributes(piece, len(lines), arrays))


def _read_line_attributes(piece: Element, num_lines: int, arrays: _DataArrays) -> dict[str, FloatArray]:
    """Read the cell data of lines.

    Cells are numbered in the order of vertices, lines, polygons and strips.
    """
    counts = [int(piece.get(f"NumberOf{kind}", "0")) for kind in ("Verts", "Lines", "Polys", "Strips")]
    found: dict[str, FloatArray] = {}
    for array in piece.iterfind("CellData/DataArray"):
        values = arrays.decode_array(array).astype(np.float64) if num_lines == counts[1] else np.empty(0)
        if num_lines and len(values) == sum(counts):
            found[array.get("Name", "")] = values[counts[0] : counts[0] + num_lines]
    return found


def _read_cells(piece: Element, kind: str, arrays: _DataArrays) -> list[IndexArray]:
    named = {array.get("Name"): array for array in piece.iterfind(f"{kind}/DataArray")}
    if not {"connectivity", "offsets"} <= set(named):
        return []
    points, ends = (arrays.decode_array(named[name]).astype(np.int64) for name in ("connectivity", "offsets"))
    if (np.diff(ends, prepend=0, append=len(points)) < 0).any():
        raise ValueError(f"the offsets of its {kind} do not fit to {len(points)} entries")
    return [points[a:b] for a, b in pairwise([0, *ends.tolist()])]


class _DataArrays:
    """Data arrays of one file."""

    def __init__(self, root: Element, appended: bytes, *, raw: bool) -> None:
        order = "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
        self._order, self._header = order, np.dtype(order + _NUMPY_TYPES[root.get("header_type", "UInt32")])
        self._appended, self._raw = appended, raw
        name = root.get("compressor")
        if name and name not in _DECOMPRESSORS:
            raise ValueError(f"is compressed by {name}; expected one of {', '.join(_DECOMPRESSORS)}, or none")
        self._decompress = _DECOMPRESSORS[name] if name else None

    def decode_array(self, array: Element) -> NDArray[np.generic]:
        """Decode one data array as one row of numbers."""
        if (kind := array.get("type", "")) not in _NUMPY_TYPES:
            raise ValueError(f"has numbers of type {kind!r}; expected one of {', '.join(_NUMPY_TYPES)}")
        dtype, form = np.dtype(self._order + _NUMPY_TYPES[kind]), array.get("format", "ascii")
        text = "".join([array.text or "", *(child.tail or "" for child in array)])  # the children are ranges
        if form == "ascii":
            return np.array(text.split(), dtype)
        if form == "appended":
            return np.frombuffer(
                self._decode_bytes(self._appended, int(array.get("offset", "0")), raw=self._raw), dtype
            )
        return np.frombuffer(self._decode_bytes("".join(text.split()).encode(), 0, raw=False), dtype)

    def _decode_bytes(self, source: bytes, at: int, *, raw: bool) -> bytes:
        """Decode the bytes of an array from an offset.

        A header with the size precedes the data or its blocks.
        """
        size = self._header.itemsize
        (count,) = self._parse_header(_read_bytes(source, at, size, raw=raw)[0])
        if self._decompress is None:
            apart = raw or source[at : at + 4 * -(-size // 3)].endswith(b"=")
            if not apart:
                return _read_bytes(source, at, size + count, raw=raw)[0][size:]
            return _read_bytes(source, _read_bytes(source, at, size, raw=raw)[1], count, raw=raw)[0]
        head, at = _read_bytes(source, at, (3 + count) * size, raw=raw)
        sizes = list(self._parse_header(head))[3:]
        whole, _ = _read_bytes(source, at, sum(sizes), raw=raw)
        ends = np.cumsum([0, *sizes]).tolist()
        return b"".join(self._decompress(whole[a:b]) for a, b in pairwise(ends))

    def _parse_header(self, header: bytes) -> Iterator[int]:
        yield from np.frombuffer(header, self._header).tolist()


def _read_bytes(source: bytes, at: int, count: int, *, raw: bool) -> tuple[bytes, int]:
    """Read `count` bytes from an offset; return them and the offset of their end.

    Raises:
        ValueError: if the source has fewer bytes.
    """
    end = at + (count if raw else 4 * -(-count // 3))
    part = source[at:end]
    found = part if raw else base64.b64decode(part)[:count]
    if len(found) < count:
        raise ValueError(f"an array declares {count} bytes, and {len(found)} are there; the file was cut")
    return found, end
