"""Reader of PLY files (Turk 1994), text or binary: vertices with attributes, and faces.

Other elements, and other properties of faces than the vertex list, are skipped; the header gives their length.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

_TYPE_SIZES = {"char": 1, "short": 2, "int": 4}
_NUMPY_TYPES = {
    **{f"{sign}{name}": f"{sign or 'i'}{size}" for name, size in _TYPE_SIZES.items() for sign in ("", "u")},
    **{f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for size in (1, 2, 4, 8) for sign in ("", "u")},
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CORNER_PROPERTIES = ("vertex_indices", "vertex_index")
_MAX_HEADER_BYTES = 2**20


class PlyProperty(NamedTuple):
    """A scalar property, or a list if `length_type` is set, the type of its length."""

    name: str
    type: str
    length_type: str = ""


class PlyElement(NamedTuple):
    """An element of the header, with its number of rows."""

    name: str
    num_rows: int
    properties: list[PlyProperty]


class PolygonContent(NamedTuple):
    """Contents of a file of points and polygons.

    Attributes:
        points: (n, 3).
        vertex_attributes: by name (n,).
        faces: number of corners k -> faces (f, k), and their zero-based numbers in the file.
        first_face_line: line of the first face if each face has its own line, else 0.
    """

    points: FloatArray
    vertex_attributes: dict[str, FloatArray]
    faces: dict[int, tuple[IndexArray, IndexArray]]
    first_face_line: int


def read_ply(content: bytes) -> PolygonContent:
    """Read the contents of a PLY file; raise ValueError for a broken one."""
    form, elements, start = _parse_header(content)
    rows_of: Callable[[PlyElement, str], _ElementRows] = (
        _TextBody(content[start:]).read_rows
        if form == "ascii"
        else _BinaryBody(content, start, _BYTE_ORDERS[form]).read_rows
    )
    columns, faces = dict[str, FloatArray](), dict[int, tuple[IndexArray, IndexArray]]()
    for element in elements:
        expected = _find_corner_property(element) if element.name == "face" else ""
        found = rows_of(element, expected)
        if element.name == "vertex":
            columns = found.columns
        elif expected:
            faces = group_by_corner_count(found.lists)
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its vertices have no {', '.join(missing)}")
    if not faces and any(element.name == "tristrips" for element in elements):
        raise ValueError("it contains triangle strips (tristrips); save it with faces instead")
    points = np.column_stack([columns.pop(axis) for axis in "xyz"])
    return PolygonContent(
        points, columns, faces, _find_first_face_line(content, start, elements) if form == "ascii" else 0
    )


def _parse_header(content: bytes) -> tuple[str, list[PlyElement], int]:
    """Parse the header: the format, the elements, and the end of the header."""
    end = re.search(rb"^end_header[ \t]*\r?\n?", content[:_MAX_HEADER_BYTES], re.M)
    if not re.match(rb"ply[ \t]*\r?\n", content) or not end:
        raise ValueError("it has no head from `ply` to `end_header`")
    form, elements = "", list[PlyElement]()
    for line in content[: end.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        match words:
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as form, _]:
                pass
            case ["element", name, rows] if re.fullmatch("[0-9]{1,15}", rows):
                elements.append(PlyElement(name, int(rows), []))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= set(_NUMPY_TYPES):
                elements[-1].properties.append(PlyProperty(name, _NUMPY_TYPES[kind], _NUMPY_TYPES[count]))
            case ["property", kind, name] if elements and kind in _NUMPY_TYPES:
                elements[-1].properties.append(PlyProperty(name, _NUMPY_TYPES[kind]))
            case _:
                raise ValueError(
                    f"its head has the line {line[:60]!r}; expected format, element or property of PLY 1.0"
                )
    if not form:
        raise ValueError("its head names no format")
    return form, elements, end.end()


def _find_corner_property(element: PlyElement) -> str:
    names = [one.name for one in element.properties if one.length_type and one.name in _CORNER_PROPERTIES]
    if not names and element.num_rows:
        raise ValueError(f"its faces have no list {' or '.join(_CORNER_PROPERTIES)}")
    return names[0] if names else ""


def group_by_corner_count(lists: list[FloatArray] | FloatArray) -> dict[int, tuple[IndexArray, IndexArray]]:
    """Group faces by their number of corners; raise ValueError for corners that are not integers."""
    if isinstance(lists, np.ndarray):
        return {lists.shape[1]: (_to_integers(lists), np.arange(len(lists)))} if len(lists) else {}
    length = np.array([len(one) for one in lists], np.int64)
    numbers = {int(k): np.flatnonzero(length == k) for k in np.unique(length)}
    return {
        k: (_to_integers(np.array([lists[i] for i in which.tolist()]).reshape(-1, k)), which)
        for k, which in numbers.items()
    }


def _to_integers(values: NDArray[np.generic]) -> IndexArray:
    numbers = np.asarray(values, np.float64)
    wrong = ~(np.abs(numbers) < 2.0**53) | (numbers != np.trunc(numbers))
    if wrong.any():
        raise ValueError(f"a face names the vertex {numbers[wrong][0]:g}; expected a whole number")
    return numbers.astype(np.int64)


def _find_first_face_line(content: bytes, start: int, elements: list[PlyElement]) -> int:
    if content[start:].rstrip().count(b"\n") + 1 != sum(element.num_rows for element in elements):
        return 0
    before = next((i for i, element in enumerate(elements) if element.name == "face"), 0)
    return content[:start].count(b"\n") + 1 + sum(element.num_rows for element in elements[:before])


class _ElementRows(NamedTuple):
    """Rows of an element: scalar columns by name (n,) and the requested list.

    The list is an array (n, k) if all lengths are equal.
    """

    columns: dict[str, FloatArray]
    lists: list[FloatArray] | FloatArray


def _make_truncation_error(element: PlyElement) -> ValueError:
    return ValueError(
        f"its head declares {element.num_rows:,} rows of {element.name}, and fewer follow; the file was cut"
    )


class _TextBody:
    """Numbers of a text body."""

    def __init__(self, body: bytes) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy only warns if a text is no number
            try:
                self._values = np.fromstring(body, np.float64, sep=" ") if body.strip() else np.empty(0)
            except (DeprecationWarning, ValueError):
                raise ValueError("something behind its head is no number") from None
        self._position = 0

    def read_rows(self, element: PlyElement, expected: str) -> _ElementRows:
        """Read the next rows; raise ValueError on failure."""
        n, properties, begun = element.num_rows, element.properties, self._position
        if not n or not properties:
            return _ElementRows({one.name: np.empty(0) for one in properties}, [])
        if len(self._values) - begun < n * len(properties):
            raise _make_truncation_error(element)
        places, self._position = self._locate_properties(element)
        width = self._position - begun
        table = self._values[begun : begun + n * width]
        if len(table) == n * width:
            table = table.reshape(n, width)
            if all(
                (table[:, places[one.name]] == table[0, places[one.name]]).all()
                for one in properties
                if one.length_type
            ):
                self._position = begun + n * width
                columns = {one.name: table[:, places[one.name]] for one in properties if not one.length_type}
                first = places.get(expected, 0)
                return _ElementRows(columns, table[:, first + 1 : first + 1 + int(table[0, first])] if expected else [])
        return self._read_unequal_rows(element, expected, begun)

    def _locate_properties(self, element: PlyElement) -> tuple[dict[str, int], int]:
        """Locate the properties and the end of the row at the current position."""
        places, at, begun = dict[str, int](), self._position, self._position
        for one in element.properties:
            places.setdefault(one.name, at - begun)
            at += 1 + (self._parse_length(element, at) if one.length_type else 0)
        if at > len(self._values):
            raise _make_truncation_error(element)
        return places, at

    def _parse_length(self, element: PlyElement, at: int) -> int:
        if at >= len(self._values):
            raise _make_truncation_error(element)
        return _check_list_length(element, float(self._values[at]))

    def _read_unequal_rows(self, element: PlyElement, expected: str, begun: int) -> _ElementRows:
        lists, columns = (
            list[FloatArray](),
            {one.name: list[float]() for one in element.properties if not one.length_type},
        )
        self._position = begun
        for _ in range(element.num_rows):
            places, end = self._locate_properties(element)
            for name, column in columns.items():
                column.append(float(self._values[self._position + places[name]]))
            if expected:
                first = self._position + places[expected]
                lists.append(self._values[first + 1 : first + 1 + int(self._values[first])])
            self._position = end
        return _ElementRows({name: np.array(column) for name, column in columns.items()}, lists)


class _BinaryBody:
    """Bytes of a binary body."""

    def __init__(self, content: bytes, start: int, order: str) -> None:
        self._content, self._position, self._order = content, start, order

    def read_rows(self, element: PlyElement, expected: str) -> _ElementRows:
        """Read the next rows; raise ValueError on failure."""
        n, properties, begun = element.num_rows, element.properties, self._position
        if not n or not properties:
            return _ElementRows({one.name: np.empty(0) for one in properties}, [])
        least = sum(np.dtype(one.length_type or one.type).itemsize for one in properties)
        if len(self._content) - begun < n * least:
            raise _make_truncation_error(element)
        fields = list[tuple[str, str, tuple[int, ...]]]()
        for i, one in enumerate(properties):
            if one.length_type:
                fields.append((f"count {i}", self._order + one.length_type, ()))
                length = self._parse_length(element, one)
                self._position += length * np.dtype(one.type).itemsize
                fields.append((f"{i}", self._order + one.type, (length,)))
            else:
                fields.append((f"{i}", self._order + one.type, ()))
                self._position += np.dtype(one.type).itemsize
        row = np.dtype(fields)
        if len(self._content) - begun >= n * row.itemsize:
            table = np.frombuffer(self._content, row, n, begun)
            counts = [f"count {i}" for i, one in enumerate(properties) if one.length_type]
            if all((table[name] == table[name][0]).all() for name in counts):
                self._position = begun + n * row.itemsize
                columns = {
                    one.name: _to_floats(table[f"{i}"]) for i, one in enumerate(properties) if not one.length_type
                }
                lists = [
                    _to_floats(table[f"{i}"]) for i, one in enumerate(properties) if expected and one.name == expected
                ]
                return _ElementRows(columns, lists[0] if lists else [])
        return self._read_unequal_rows(element, expected, begun)

    def _parse_length(self, element: PlyElement, one: PlyProperty) -> int:
        """Read the length of the list at the current position, and advance past it."""
        (value,) = self._read_values(element, one.length_type, 1).tolist()
        length = _check_list_length(element, value)
        if len(self._content) - self._position < length * np.dtype(one.type).itemsize:
            raise _make_truncation_error(element)
        return length

    def _read_values(self, element: PlyElement, kind: str, count: int) -> NDArray[np.generic]:
        dtype = np.dtype(self._order + kind)
        begun, self._position = self._position, self._position + count * dtype.itemsize
        if self._position > len(self._content):
            raise _make_truncation_error(element)
        return np.frombuffer(self._content, dtype, count, begun)

    def _read_unequal_rows(self, element: PlyElement, expected: str, begun: int) -> _ElementRows:
        lists, columns = (
            list[FloatArray](),
            {one.name: list[float]() for one in element.properties if not one.length_type},
        )
        self._position = begun
        for _ in range(element.num_rows):
            for one in element.properties:
                if not one.length_type:
                    columns[one.name].append(float(self._read_values(element, one.type, 1)[0]))
                    continue
                values = self._read_values(element, one.type, self._parse_length(element, one))
                if one.name == expected:
                    lists.append(_to_floats(values))
        return _ElementRows({name: np.array(column) for name, column in columns.items()}, lists)


def _check_list_length(element: PlyElement, length: float) -> int:
    """Return the length of a list as an integer; raise ValueError if it is none."""
    if not 0 <= length < 2**32 or length != int(length):
        raise ValueError(f"a list of its {element.name} has the length {length:g}; expected a whole number")
    return int(length)


def _to_floats(values: NDArray[np.generic]) -> FloatArray:
    return np.ascontiguousarray(values, np.float64)
