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

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_SIZES = {"char": 1, "short": 2, "int": 4}
_TYPES = {
    **{f"{sign}{name}": f"{sign or 'i'}{size}" for name, size in _SIZES.items() for sign in ("", "u")},
    **{f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for size in (1, 2, 4, 8) for sign in ("", "u")},
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = ("vertex_indices", "vertex_index")
_MOST_OF_HEAD = 2**20


class Property(NamedTuple):
    """A scalar property, or a list if `length` is set, the type of its length."""

    name: str
    type: str
    length: str = ""


class Element(NamedTuple):
    """An element of the header, with its number of rows."""

    name: str
    rows: int
    properties: list[Property]


class Ply(NamedTuple):
    """Contents of a PLY file.

    Attributes:
        points: (n, 3).
        numbers: by name (n,).
        faces: number of corners k -> faces (f, k), and their zero-based numbers in the file.
        first_line: line of the first face if each face has its own line, else 0.
    """

    points: Array
    numbers: dict[str, Array]
    faces: dict[int, tuple[Indices, Indices]]
    first_line: int


def read(content: bytes) -> Ply:
    """Read the contents of a PLY file; raise ValueError for a broken one."""
    form, elements, start = _head(content)
    rows_of: Callable[[Element, str], _Rows] = (
        _Text(content[start:]).rows if form == "ascii" else _Binary(content, start, _ORDERS[form]).rows
    )
    columns, faces = dict[str, Array](), dict[int, tuple[Indices, Indices]]()
    for element in elements:
        wanted = _list_of_corners(element) if element.name == "face" else ""
        found = rows_of(element, wanted)
        if element.name == "vertex":
            columns = found.columns
        elif wanted:
            faces = _by_corners(found.lists)
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise ValueError(f"its vertices have no {', '.join(missing)}")
    if not faces and any(element.name == "tristrips" for element in elements):
        raise ValueError("it holds triangle strips (tristrips); save it with faces instead")
    points = np.column_stack([columns.pop(axis) for axis in "xyz"])
    return Ply(points, columns, faces, _first_line(content, start, elements) if form == "ascii" else 0)


def _head(content: bytes) -> tuple[str, list[Element], int]:
    """Parse the header: the format, the elements, and the end of the header."""
    end = re.search(rb"^end_header[ \t]*\r?\n?", content[:_MOST_OF_HEAD], re.M)
    if not re.match(rb"ply[ \t]*\r?\n", content) or not end:
        raise ValueError("it has no head from `ply` to `end_header`")
    form, elements = "", list[Element]()
    for line in content[: end.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        match words:
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as form, _]:
                pass
            case ["element", name, rows] if re.fullmatch("[0-9]{1,15}", rows):
                elements.append(Element(name, int(rows), []))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= set(_TYPES):
                elements[-1].properties.append(Property(name, _TYPES[kind], _TYPES[count]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append(Property(name, _TYPES[kind]))
            case _:
                raise ValueError(f"its head has the line {line[:60]!r}; wanted format, element or property of PLY 1.0")
    if not form:
        raise ValueError("its head names no format")
    return form, elements, end.end()


def _list_of_corners(element: Element) -> str:
    names = [one.name for one in element.properties if one.length and one.name in _CORNERS]
    if not names and element.rows:
        raise ValueError(f"its faces have no list {' or '.join(_CORNERS)}")
    return names[0] if names else ""


def _by_corners(lists: list[Array] | Array) -> dict[int, tuple[Indices, Indices]]:
    """Group faces by their number of corners; raise ValueError for corners that are not integers."""
    if isinstance(lists, np.ndarray):
        return {lists.shape[1]: (_whole(lists), np.arange(len(lists)))} if len(lists) else {}
    length = np.array([len(one) for one in lists], np.int64)
    numbers = {int(k): np.flatnonzero(length == k) for k in np.unique(length)}
    return {
        k: (_whole(np.array([lists[i] for i in which.tolist()]).reshape(-1, k)), which) for k, which in numbers.items()
    }


def _whole(values: NDArray[np.generic]) -> Indices:
    numbers = np.asarray(values, np.float64)
    wrong = ~(np.abs(numbers) < 2.0**53) | (numbers != np.trunc(numbers))
    if wrong.any():
        raise ValueError(f"a face names the vertex {numbers[wrong][0]:g}; wanted a whole number")
    return numbers.astype(np.int64)


def _first_line(content: bytes, start: int, elements: list[Element]) -> int:
    if content[start:].rstrip().count(b"\n") + 1 != sum(element.rows for element in elements):
        return 0
    before = next((i for i, element in enumerate(elements) if element.name == "face"), 0)
    return content[:start].count(b"\n") + 1 + sum(element.rows for element in elements[:before])


class _Rows(NamedTuple):
    """Rows of an element: scalar columns by name (n,) and the requested list.

    The list is an array (n, k) if all lengths are equal.
    """

    columns: dict[str, Array]
    lists: list[Array] | Array


def _short(element: Element) -> ValueError:
    return ValueError(f"its head promises {element.rows:,} rows of {element.name}, and fewer follow; the file was cut")


class _Text:
    """Numbers of a text body."""

    def __init__(self, body: bytes) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # which says that something is no number
            try:
                self._values = np.fromstring(body, np.float64, sep=" ") if body.strip() else np.empty(0)
            except (DeprecationWarning, ValueError):
                raise ValueError("something behind its head is no number") from None
        self._at = 0

    def rows(self, element: Element, wanted: str) -> _Rows:
        """Read the next rows; raise ValueError on failure."""
        n, properties, begun = element.rows, element.properties, self._at
        if not n or not properties:
            return _Rows({one.name: np.empty(0) for one in properties}, [])
        if len(self._values) - begun < n * len(properties):
            raise _short(element)
        places, self._at = self._widths(element)
        width = self._at - begun
        table = self._values[begun : begun + n * width]
        if len(table) == n * width:
            table = table.reshape(n, width)
            if all(
                (table[:, places[one.name]] == table[0, places[one.name]]).all() for one in properties if one.length
            ):
                self._at = begun + n * width
                columns = {one.name: table[:, places[one.name]] for one in properties if not one.length}
                first = places.get(wanted, 0)
                return _Rows(columns, table[:, first + 1 : first + 1 + int(table[0, first])] if wanted else [])
        return self._unequal(element, wanted, begun)

    def _widths(self, element: Element) -> tuple[dict[str, int], int]:
        """Locate the properties of the row that starts here, and the end of the row."""
        places, at, begun = dict[str, int](), self._at, self._at
        for one in element.properties:
            places.setdefault(one.name, at - begun)
            at += 1 + (self._length(element, at) if one.length else 0)
        if at > len(self._values):
            raise _short(element)
        return places, at

    def _length(self, element: Element, at: int) -> int:
        if at >= len(self._values):
            raise _short(element)
        value = float(self._values[at])
        if not 0 <= value < 2**32 or value != int(value):
            raise ValueError(f"a list of its {element.name} has the length {value:g}; wanted a whole number")
        return int(value)

    def _unequal(self, element: Element, wanted: str, begun: int) -> _Rows:
        lists, columns = list[Array](), {one.name: list[float]() for one in element.properties if not one.length}
        self._at = begun
        for _ in range(element.rows):
            places, end = self._widths(element)
            for name, column in columns.items():
                column.append(float(self._values[self._at + places[name]]))
            if wanted:
                first = self._at + places[wanted]
                lists.append(self._values[first + 1 : first + 1 + int(self._values[first])])
            self._at = end
        return _Rows({name: np.array(column) for name, column in columns.items()}, lists)


class _Binary:
    """Bytes of a binary body."""

    def __init__(self, content: bytes, start: int, order: str) -> None:
        self._content, self._at, self._order = content, start, order

    def rows(self, element: Element, wanted: str) -> _Rows:
        """Read the next rows; raise ValueError on failure."""
        n, properties, begun = element.rows, element.properties, self._at
        if not n or not properties:
            return _Rows({one.name: np.empty(0) for one in properties}, [])
        least = sum(np.dtype(one.length or one.type).itemsize for one in properties)
        if len(self._content) - begun < n * least:
            raise _short(element)
        fields = list[tuple[str, str, tuple[int, ...]]]()
        for i, one in enumerate(properties):
            if one.length:
                fields.append((f"count {i}", self._order + one.length, ()))
                length = self._length(element, one)
                self._at += length * np.dtype(one.type).itemsize
                fields.append((f"{i}", self._order + one.type, (length,)))
            else:
                fields.append((f"{i}", self._order + one.type, ()))
                self._at += np.dtype(one.type).itemsize
        row = np.dtype(fields)
        if len(self._content) - begun >= n * row.itemsize:
            table = np.frombuffer(self._content, row, n, begun)
            counts = [f"count {i}" for i, one in enumerate(properties) if one.length]
            if all((table[name] == table[name][0]).all() for name in counts):
                self._at = begun + n * row.itemsize
                columns = {one.name: _numbers(table[f"{i}"]) for i, one in enumerate(properties) if not one.length}
                lists = [_numbers(table[f"{i}"]) for i, one in enumerate(properties) if wanted and one.name == wanted]
                return _Rows(columns, lists[0] if lists else [])
        return self._unequal(element, wanted, begun)

    def _length(self, element: Element, one: Property) -> int:
        """Read the length of the list that starts here, and advance past it."""
        (value,) = self._taken(element, one.length, 1).tolist()
        if not 0 <= value < 2**32 or value != int(value):
            raise ValueError(f"a list of its {element.name} has the length {value:g}; wanted a whole number")
        if len(self._content) - self._at < int(value) * np.dtype(one.type).itemsize:
            raise _short(element)
        return int(value)

    def _taken(self, element: Element, kind: str, count: int) -> NDArray[np.generic]:
        dtype = np.dtype(self._order + kind)
        begun, self._at = self._at, self._at + count * dtype.itemsize
        if self._at > len(self._content):
            raise _short(element)
        return np.frombuffer(self._content, dtype, count, begun)

    def _unequal(self, element: Element, wanted: str, begun: int) -> _Rows:
        lists, columns = list[Array](), {one.name: list[float]() for one in element.properties if not one.length}
        self._at = begun
        for _ in range(element.rows):
            for one in element.properties:
                if not one.length:
                    columns[one.name].append(float(self._taken(element, one.type, 1)[0]))
                    continue
                values = self._taken(element, one.type, self._length(element, one))
                if one.name == wanted:
                    lists.append(_numbers(values))
        return _Rows({name: np.array(column) for name, column in columns.items()}, lists)


def _numbers(values: NDArray[np.generic]) -> Array:
    return np.ascontiguousarray(values, np.float64)
