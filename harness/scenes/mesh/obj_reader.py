"""Strict reader of Wavefront OBJ: vertices, polygons of any number of corners, lines.

A `\\` at the end of a line continues the statement on the next line. Vertex tokens are `v`, `v/vt`, `v//vn` or
`v/vt/vn`, counted from 1, or from -1 backwards from the last vertex read so far. An `f` line of two
vertices is a spring, as in scenes of the Toronto assignment; an `l` line is a polyline. Texture,
normals, groups and materials are ignored; anything else is a mistake.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.scenes.mesh.mesh_generator import MAX_VERTICES
from springbench.harness.scenes.mesh.mesh_topology import NO_PAIRS
from springbench.harness.scenes.mesh.spring_network import (
    MAX_COORDINATE,
    MeshCells,
    check_mesh_file,
    describe_repeated_corner,
)

_RENDERING_KEYWORDS = {
    "bevel",
    "c_interp",
    "d_interp",
    "shadow_obj",
    "trace_obj",
    "mtllib",
    "usemtl",
    "maplib",
    "usemap",
    "lod",
}
_IGNORED_KEYWORDS = _RENDERING_KEYWORDS | {"vt", "vn", "vp", "p", "s", "mg"}
_CORNER_TOKEN = re.compile(r"([+-]?[0-9]+)(/[+-]?[0-9]*(/[+-]?[0-9]*)?)?")
_MAX_MISTAKES = 20


def read_obj(path: Path) -> MeshCells:
    """Read the points, polygons (`f`) and segments (`l`) of an OBJ file, in file order.

    Raises:
        InputError: with the lines, for unreadable statements, numbers that are not finite, indices out of range,
            and empty or oversized files.
    """
    check_mesh_file(path)
    reader = _ObjReader(path)
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            for number, text in _split_statements(file):
                reader.read_statement(number, text)
                if len(reader.mistakes) >= _MAX_MISTAKES:
                    break
                if len(reader.points) > MAX_VERTICES:
                    raise InputError(InputMistake(f"has more than {MAX_VERTICES:,} vertices", path, number))
                reader.last_line = number
    except OSError as error:
        raise InputError(InputMistake(f"cannot be read ({error.strerror})", path)) from None
    if reader.mistakes and reader.mistakes[-1].line == reader.last_line and not _ends_with_a_line_end(path):
        last = reader.mistakes[-1]
        reader.mistakes[-1] = replace(last, problem=f"{last.problem}; the file ends within this line: was it cut?")
    return reader.build_cells()


def _ends_with_a_line_end(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) in (b"\n", b"\r")


def _split_statements(lines: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Yield statements without comments, each with the number of its first line."""
    begun, parts = 0, list[str]()
    for number, line in enumerate(lines, 1):
        text, comment, _ = line.partition("#")
        continued = not comment and (text := text.rstrip()).endswith("\\")
        begun = begun or number
        parts.append(text[:-1] if continued else text)
        if not continued:
            yield begun, " ".join(parts)
            begun, parts = 0, []
    if parts:
        yield begun, " ".join(parts)


class _ObjReader:
    """Collects statements; all mistakes are reported together at the end.

    Repeated corners are mistakes only in addition to others: the cleaning of the cells may join them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.points: list[tuple[float, float, float]] = []
        self.polygons: dict[int, list[list[int]]] = defaultdict(list)
        self.lines: dict[int, list[int]] = defaultdict(list)
        self.segments: list[list[int]] = []
        self.segment_lines: list[int] = []
        self.colours: list[tuple[float, ...]] = []
        self.groups: dict[str, set[int]] = defaultdict(set)
        self.current_groups: list[str] = []
        self.last_line = 0
        self.mistakes: list[InputMistake] = []
        self.repetitions: list[InputMistake] = []

    def read_statement(self, number: int, text: str) -> None:
        """Read one statement that starts in line `number`."""
        keyword, *words = text.split() or [""]
        try:
            if keyword == "v":
                self.points.append(_parse_point(words))
                self.colours += [_parse_colour(words[3:])] if len(words) == 6 else []
            elif keyword in ("g", "o"):
                self.current_groups = words
            elif keyword == "f":
                corners = self._parse_corners(words)
                if len(set(corners)) < len(corners):
                    self.repetitions.append(InputMistake(describe_repeated_corner(len(corners)), self.path, number))
                self.polygons[len(corners)].append(corners)
                self.lines[len(corners)].append(number)
                self._add_to_groups(corners)
            elif keyword == "l":
                corners = self._parse_corners(words)
                segments = [[a, b] for a, b in pairwise(corners)]
                if any(a == b for a, b in segments):
                    self.repetitions.append(InputMistake(describe_repeated_corner(2), self.path, number))
                self.segments += segments
                self.segment_lines += [number] * len(segments)
                self._add_to_groups(corners)
            elif keyword and keyword not in _IGNORED_KEYWORDS:
                raise ValueError(f"unknown keyword {keyword[:40]!r}; expected v, f, l or what OBJ files may carry")
        except ValueError as error:
            self.mistakes.append(InputMistake(str(error), self.path, number))

    def _add_to_groups(self, corners: list[int]) -> None:
        for name in self.current_groups:
            self.groups[name].update(corners)

    def _parse_corners(self, words: list[str]) -> list[int]:
        """Parse zero-based vertices; their existence is checked at the end of the file."""
        if len(words) < 2:
            raise ValueError(f"a face or line needs at least 2 vertices, got {len(words)}")
        corners: list[int] = []
        for word in words:
            match = _CORNER_TOKEN.fullmatch(word)
            index = int(match[1][:20]) if match else 0
            if not index:
                raise ValueError(f"{word[:40]!r} is no vertex; expected v, v/vt, v//vn or v/vt/vn, counted from 1")
            corners.append(index - 1 if index > 0 else len(self.points) + index)
            if corners[-1] < 0:
                raise ValueError(f"vertex {index} lies before the first; only {len(self.points)} are listed before it")
        return corners

    def build_cells(self) -> MeshCells:
        """Return the cells; raise InputError with all mistakes."""
        if not self.mistakes and not self.points:
            self.mistakes.append(InputMistake("has no vertices (v lines)", self.path))
        if not self.mistakes:
            for corners, polygons in self.polygons.items():
                self._check_range(polygons, self.lines[corners])
            self._check_range(self.segments, self.segment_lines)
        if self.mistakes:
            raise InputError(sorted(self.mistakes + self.repetitions, key=lambda m: m.line or 0)[:_MAX_MISTAKES])
        colours = self.colours if len(self.colours) == len(self.points) else []
        return MeshCells(
            vertex_groups={name: np.array(sorted(group), np.int64) for name, group in self.groups.items()},
            attributes=dict(zip(("red", "green", "blue"), np.array(colours).T.copy(), strict=False)),
            points=np.array(self.points, np.float64),
            polygons={k: np.array(self.polygons[k], np.int64) for k in sorted(self.polygons)},
            polygon_locations={k: np.array(lines, np.int64) for k, lines in self.lines.items()},
            location_unit="line",
            file_numbers=np.arange(1, len(self.points) + 1),
            segments=np.array(self.segments, np.int64) if self.segments else NO_PAIRS,
            segment_locations=np.array(self.segment_lines, np.int64),
        )

    def _check_range(self, groups: list[list[int]], lines: list[int]) -> None:
        n = len(self.points)
        for corners, line in zip(groups, lines, strict=True):
            if max(corners) >= n:
                problem = f"vertex {max(corners) + 1} does not exist; the file has {n} vertices, counted from 1"
                self.mistakes.append(InputMistake(problem, self.path, line))


def _parse_point(words: list[str]) -> tuple[float, float, float]:
    """Parse the position of a `v` line, optionally followed by a weight or a colour."""
    if not 3 <= len(words) <= 7:
        raise ValueError(f"a vertex needs 3 coordinates (and at most a weight and a colour), got {len(words)}")
    x, y, z = map(_parse_coordinate, words[:3])
    return x, y, z


def _parse_colour(words: list[str]) -> tuple[float, ...]:
    """Parse a colour; NaN, which some programs write for no colour, is black."""
    return tuple(0.0 if word.lower() == "nan" else _parse_coordinate(word) for word in words)


def _parse_coordinate(word: str) -> float:
    try:
        value = float(word.replace("_", "?"))  # Python would read 1_0 as ten
    except ValueError:
        raise ValueError(f"{word[:40]!r} is no number; expected a coordinate in metres") from None
    if not abs(value) <= MAX_COORDINATE:
        raise ValueError(f"{word[:40]!r} is no position; expected a finite number up to {MAX_COORDINATE:g} m")
    return value
