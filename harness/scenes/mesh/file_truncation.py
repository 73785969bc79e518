"""Detection of mesh files that were cut before their end, by format.

A reader that fails on such a file reports a symptom, such as a shape or a decoding error. Some readers accept it, and
VTK replaces the missing part by arbitrary numbers. The checks compare the contents with the counts that the head of the
file declares, or look for its end marker.
"""

from __future__ import annotations

import re
from collections.abc import Callable

_GMSH_SECTION = re.compile(
    rb"^\$(End)?((?:MeshFormat|PhysicalNames|Entities|Nodes|Elements|Periodic)\b|\w+Data\b)", re.M
)
_XML_ROOT = re.compile(rb"<([A-Za-z][\w:.-]*)[\s>]")

_VTK_SIZES = {"char": 1, "short": 2, "int": 4, "long": 8, "float": 4, "double": 8, "vtkidtype": 4,
              "vtktypeint32": 4, "vtktypeint64": 8}  # fmt: skip
"""Bytes of a number in a binary VTK file, by its type; unsigned ones have those of the signed ones."""
_VTK_CELLS = ("CELLS", "POLYGONS", "LINES", "VERTICES", "TRIANGLE_STRIPS")
_VTK_COMPONENTS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9}


def find_strict_truncation(suffix: str, content: bytes) -> str:
    """Describe what a truncated file lacks; empty for a complete or an unchecked one.

    Args:
        suffix: suffix of the file, lower case with the dot.
        content: content of the file.
    """
    check = _STRICT_CHECKS.get(suffix)
    return check(content) if check else ""


def guess_truncation(suffix: str, content: bytes) -> str:
    """Describe what a file that cannot be read seems to lack.

    Args:
        suffix: suffix of the file, lower case with the dot.
        content: content of the file.

    Returns:
        The description; empty if nothing indicates that the file was cut.
    """
    if what := find_strict_truncation(suffix, content):
        return what
    check = _WEAK_CHECKS.get(suffix)
    if check and (what := check(content)):
        return what
    is_text = b"\0" not in content
    return "its last line has no line end" if is_text and not content.endswith((b"\n", b"\r")) else ""


def _find_open_gmsh_section(content: bytes) -> str:
    """Describe an open section of a Gmsh file; empty if there is none.

    The ANSYS format of the same suffix has no sections.
    """
    open_sections: dict[bytes, int] = {}
    for end, name in _GMSH_SECTION.findall(content):
        open_sections[name] = open_sections.get(name, 0) + (-1 if end else 1)
    left = next((name.decode() for name, count in open_sections.items() if count > 0), "")
    if left:
        return f"the section ${left} has no $End{left}"
    return "it has no section $Elements" if b"MeshFormat" in open_sections and b"Elements" not in open_sections else ""


def _find_open_xml(content: bytes) -> str:
    root = _XML_ROOT.search(content)
    if root is None or content.rstrip(b"\0 \t\r\n").endswith(b"</" + root[1] + b">"):
        return ""
    return f"it does not end with </{root[1].decode()}>"


def _find_open_json(content: bytes) -> str:
    is_open = content.lstrip().startswith(b"{") and not content.rstrip().endswith(b"}")
    return "it does not end with }" if is_open else ""


def _find_missing_word(word: bytes, name: str) -> Callable[[bytes], str]:
    def check(content: bytes) -> str:
        return "" if re.search(rb"^\s*" + word + rb"\b", content, re.M | re.I) else f"it has no {name}"

    return check


class _VtkScan:
    """Walks through the sections of a legacy VTK file."""

    def __init__(self, content: bytes) -> None:
        self.content = content
        self.place = 0
        self.read_line()
        self.read_line()
        self.is_binary = self.read_line().strip().upper() == b"BINARY"

    def read_line(self) -> bytes:
        """Return the next line, which may be empty; at the end of the file nothing."""
        end = self.content.find(b"\n", self.place) + 1 or len(self.content)
        line = self.content[self.place : end]
        self.place = end
        return line

    def skip_values(self, count: int, kind: str, first: int = 0) -> bool:
        """Skip `count` numbers; return whether they exist.

        In a text file, `first` of them are in the line that was read.
        """
        if self.is_binary:
            self.place += count * _VTK_SIZES[kind]
            return self.place <= len(self.content)
        while first < count and self.place < len(self.content):
            first += len(self.read_line().split())
        return first >= count


def _find_cut_vtk(content: bytes) -> str:
    """Compare the counts declared in a legacy VTK file with the numbers that follow.

    Each section declares its counts. The format is that of
    https://docs.vtk.org/en/latest/vtk_file_formats/vtk_legacy_file_format.html. The check ends at the first section of
    an unknown name.
    """
    if not content.startswith(b"# vtk DataFile"):
        return ""
    scan = _VtkScan(content)
    rows, cells = 0, (0, 0)
    found = set[str]()
    while scan.place < len(content):
        words = scan.read_line().decode("latin-1").split()
        if not words:
            continue
        name = words[0].upper()
        found.add(name)
        try:
            numbers = [int(word) for word in words[1:] if word.isdigit()]
            kind, used, count = words[-1].lower().removeprefix("unsigned_"), len(words), 0
            if name in ("DATASET", "LOOKUP_TABLE"):
                continue
            if name == "METADATA":
                while scan.read_line().strip():
                    pass
                continue
            if name == "POINTS":
                count, kind, used = 3 * numbers[0], words[2].lower(), 3
            elif name in _VTK_CELLS:
                cells, used = (numbers[0], numbers[1]), 3
                if _has_next_word(scan, b"OFFSETS"):
                    continue
                count, kind = cells[1], "int"
            elif name in ("OFFSETS", "CONNECTIVITY"):
                count = cells[name == "CONNECTIVITY"]
            elif name == "CELL_TYPES":
                count, kind = numbers[0], "int"
            elif name in ("POINT_DATA", "CELL_DATA"):
                rows = numbers[0]
                continue
            elif name == "SCALARS":
                count, kind = rows * (int(words[3]) if len(words) > 3 else 1), words[2].lower()
                kind = kind.removeprefix("unsigned_")
                if _has_next_word(scan, b"LOOKUP_TABLE"):
                    scan.read_line()
            elif name in _VTK_COMPONENTS:
                count = rows * _VTK_COMPONENTS[name]
            elif name == "TEXTURE_COORDINATES":
                count = rows * int(words[2])
            else:
                raise KeyError(name)
            if not scan.skip_values(count, kind, len(words) - used):
                return f"its section {name} declares {count:,} numbers, and fewer follow"
        except (IndexError, KeyError, ValueError):
            if scan.place >= len(content):
                return f"it ends at the head of its section {name[:40]}"
            break
    lacks_types = "CELLS" in found and "CELL_TYPES" not in found and scan.place >= len(content)
    return "it has no section CELL_TYPES" if lacks_types else ""


def _has_next_word(scan: _VtkScan, word: bytes) -> bool:
    return scan.content[scan.place : scan.place + 100].lstrip().upper().startswith(word)


_STRICT_CHECKS: dict[str, Callable[[bytes], str]] = {
    ".msh": _find_open_gmsh_section,
    ".vtk": _find_cut_vtk,
    **dict.fromkeys((".vtp", ".vtu", ".xdmf", ".xmf"), _find_open_xml),
    ".gltf": _find_open_json,
}
"""Checks that no complete file fails."""
_WEAK_CHECKS: dict[str, Callable[[bytes], str]] = {
    ".mesh": _find_missing_word(b"End", "End"),
    **dict.fromkeys((".nas", ".bdf", ".fem"), _find_missing_word(b"ENDDATA", "ENDDATA")),
}
"""Checks that some complete files fail; they apply only to files that cannot be read."""
