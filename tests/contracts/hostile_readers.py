"""Hostile files for each reader: what each contains, and words of the answer; cases by the reader and the file's name.

Mesh files are named by a scene; other cases are a scene of their own, which may name files of `OTHER_FILES`.
"""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from typing import Any

import numpy as np

from tests.contracts.hostile import scene

XYZ = "property float x\nproperty float y\nproperty float z\n"
CORNERS = "property list uchar int vertex_indices\n"
SQUARE = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
OBJ = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
POINTS = struct.pack("<12f", 0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0)


def ply(body: bytes | str, *, vertex: str = XYZ, face: str = CORNERS, kind: str = "ascii", n: object = 4) -> bytes:
    head = f"ply\nformat {kind} 1.0\nelement vertex {n}\n{vertex}element face 1\n{face}end_header\n"
    return head.encode() + (body if isinstance(body, bytes) else body.encode())


LITTLE = "binary_little_endian"
MSH = "$MeshFormat\n{version} 0 8\n$EndMeshFormat\n"
MSH22 = MSH.format(version="2.2") + "$Nodes\n4\n1 0 0 0\n2 1 0 0\n3 1 1 0\n4 0 1 0\n$EndNodes\n"
MSH41 = MSH.format(version="4.1")
NODES41 = "$Nodes\n1 4 1 4\n2 1 0 4\n1\n2\n3\n4\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n$EndNodes\n"
CELLS41 = "$Elements\n1 2 1 2\n2 1 2 2\n1 1 2 3\n2 1 3 4\n$EndElements\n"
VTK = "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 4 float\n" + SQUARE
VTP = '<VTKFile type="PolyData" version="1.0"{more}><PolyData><Piece>{piece}</Piece></PolyData></VTKFile>'
ARRAY = '<DataArray type="{type}" Name="{name}" format="{form}"{more}>{text}</DataArray>'


def array(text: object, *, type: str = "Float64", name: str = "x", form: str = "ascii", more: str = "") -> str:
    return ARRAY.format(text=text, type=type, name=name, form=form, more=more)


def vtp(connectivity: str = "0 1 2 3", offsets: str = "4", points: str = "", more: str = "") -> bytes:
    """A square, parts of it exchanged."""
    cells = array(connectivity, type="Int64", name="connectivity") + array(offsets, type="Int64", name="offsets")
    piece = f"<Points>{points or array(SQUARE)}</Points><Polys>{cells}</Polys>"
    return VTP.format(piece=piece, more=more).encode()


def stl(*triangles: tuple[float, ...], count: int | None = None) -> bytes:
    """A binary STL; a triangle has nine coordinates."""
    body = b"".join(struct.pack("<12fH", 0, 0, 1, *one, 0) for one in triangles)
    return bytes(80) + struct.pack("<I", len(triangles) if count is None else count) + body


def off(points: str, faces: str, counts: str = "4 1 0") -> bytes:
    return f"OFF\n{counts}\n{points}{faces}".encode()


SAW = "".join(f"v {i} {i % 2} 0\n" for i in range(4998)) + "v 4997 9 0\nv 0 9 0\n"
TANGLE = "".join(f"v {(i * 7919) % 1999} {(i * i) % 1999} 0\n" for i in range(1999))
MANY = "".join(f"property int p{i}\n" for i in range(10_000))


def face(corners: int) -> str:
    return "f " + " ".join(map(str, range(1, corners + 1))) + "\n"


MESHES: dict[str, tuple[bytes | str, str]] = {
    # OBJ
    "crossed.obj": (OBJ + "f 1 3 2 4\n", ":5: the sides of this face cross"),
    "continued-for-ever.obj": (OBJ + "f 1" + " 2 3 \\\n" * 200_000, "names a vertex twice"),
    "continued-into-a-keyword.obj": (OBJ + "f 1 2 \\\nf 3 4\n", ":5: 'f' is no vertex"),
    "only-backslashes.obj": ("\\\n" * 300_000, "no vertices"),
    "a-backslash-inside.obj": (OBJ + "f 1 2\\3 4\n", "is no vertex"),
    "a-face-of-500000-corners.obj": (OBJ + "f" + " 1 2 3 4" * 125_000 + "\n", "names a vertex twice"),
    "a-saw-of-5000-corners.obj": (SAW + face(5000), "is not convex; split it"),
    "a-tangle-of-1999-corners.obj": (TANGLE + face(1999), "sides of this face cross"),
    "relative-before-the-first.obj": ("f -1 -2 -3\n" + OBJ, "lies before the first"),
    "index-beyond-64-bits.obj": (OBJ + f"f 1 2 {2**64 + 3}\n", "does not exist"),
    "hexadecimal.obj": (OBJ + "f 1 2 0x3\n", "is no vertex"),
    "arabic-digits.obj": (OBJ + "f 1 2 \u0663\n", "is no vertex"),
    "utf-16.obj": (("\ufeff" + OBJ + "f 1 2 3\n").encode("utf-16-le"), "unknown keyword"),
    "a-line-of-4-MB.obj": (OBJ + "x" * 2**22, "unknown keyword"),
    "a-group-of-4-MB.obj": (OBJ + "g " + "x" * 2**22 + "\nf 1 2 3 9\n", "vertex 9 does not exist"),
    "gzip.obj": (gzip.compress(b"v 0 0 0\n" * 1000), "gzip.obj"),
    # PLY
    "negative-list.ply": (ply(SQUARE + "-1\n"), "length -1"),
    "list-of-1e9-in-text.ply": (ply(SQUARE + "1e9 0 1 2\n"), "fewer follow"),
    "list-of-4e9.ply": (ply(POINTS + b"\xff\xff\xff\xff", kind=LITTLE, face=CORNERS.replace("uchar", "uint")), "fewer"),
    "list-with-a-length-in-float.ply": (
        ply(POINTS + struct.pack("<f3i", 2.5, 0, 1, 2), kind=LITTLE, face=CORNERS.replace("uchar", "float")),
        "length 2.5",
    ),
    "list-of-nan.ply": (
        ply(POINTS + struct.pack("<f3i", float("nan"), 0, 1, 2), kind=LITTLE, face=CORNERS.replace("uchar", "float")),
        "length nan",
    ),
    "corners-in-float.ply": (ply(SQUARE + "3 0 1 1e300\n"), "1e+300"),
    "999999999999999-rows-of-nothing.ply": (
        ply(SQUARE + "3 0 1 2\n", n="4\n" + XYZ + "element x 999999999999999\nelement y 1", vertex="property int z\n"),
        "fewer than 2 points",
    ),
    "999999999999999-rows-of-lists.ply": (
        ply(b"\0" * 100, n=999999999999999, vertex="property list uchar int x\n", kind=LITTLE),
        "declares 999,999,999,999,999 rows of vertex",
    ),
    "10000-properties.ply": (
        ply(SQUARE, vertex=MANY),
        "fewer follow",
    ),
    "head-of-2-MB.ply": (ply(SQUARE, vertex="comment x\n" * 200_000 + XYZ), "no head"),
    "property-before-an-element.ply": (b"ply\nformat ascii 1.0\nproperty int x\nend_header\n", "property int x"),
    "format-9.ply": (ply(SQUARE, kind="binary_middle_endian"), "binary_middle_endian"),
    "vertices-twice.ply": (ply(SQUARE * 2 + "3 0 1 9\n", vertex=XYZ + "element vertex 4\n" + XYZ), "[0, 1, 9]"),
    "list-as-a-coordinate.ply": (ply(SQUARE, vertex=XYZ.replace("float z", "list uchar int z")), "rows of face"),
    "strips-alone.ply": (
        b"ply\nformat ascii 1.0\nelement vertex 4\n" + XYZ.encode() + b"element tristrips 1\n"
        b"property list int int vertex_indices\nend_header\n" + SQUARE.encode() + b"4 0 1 2 3\n",
        "triangle strips",
    ),
    "carriage-returns-alone.ply": (ply(SQUARE + "3 0 1 2\n").replace(b"\n", b"\r"), "no head"),
    "numbers-with-underscores.ply": (ply(SQUARE.replace("1 1 0", "1_0 1 0") + "3 0 1 2\n"), "is no number"),
    "nul-in-text.ply": (ply(SQUARE.replace("1 1 0", "1\0 1 0") + "3 0 1 2\n"), "nul-in-text.ply"),
    # STL
    "nan.stl": (stl((0, 0, 0, 1, 0, 0, float("nan"), 1, 0)), "nan.stl"),
    "infinite.stl": (stl((0, 0, 0, 1, 0, 0, float("inf"), 1, 0)), "infinite.stl"),
    "no-area.stl": (stl((0, 0, 0, 1, 0, 0, 2, 0, 0)), "without any size"),
    "all-corners-in-one.stl": (stl((1, 1, 1) * 3), "all-corners-in-one.stl"),
    "more-than-declared.stl": (stl(*[(0, 0, 0, 1, 0, 0, 0, 1, 0)] * 2, count=1) + b"x" * 7, "more-than-declared.stl"),
    "words.stl": (b"solid\nfacet normal a b c\nouter loop\nvertex x y z\nendloop\nendfacet\nendsolid\n", "words.stl"),
    "loop-of-two.stl": (
        b"solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nendloop\nendfacet\nendsolid\n",
        "loop-of-two.stl",
    ),
    # Gmsh
    "type-of-no-such-number.msh": (MSH22 + "$Elements\n1\n1 999 2 0 1 1 2 3\n$EndElements\n", "msh"),
    "node-of-no-such-number.msh": (MSH22 + "$Elements\n1\n1 2 2 0 1 1 2 9\n$EndElements\n", "msh"),
    "node-of-1e9.msh": (MSH22.replace("4 0 1 0", "1000000000 0 1 0") + "$Elements\n0\n$EndElements\n", "msh"),
    "tags-of-words.msh": (MSH22 + "$Elements\n1\n1 2 many 0 1 1 2 3\n$EndElements\n", "msh"),
    "negative-node.msh": (MSH22 + "$Elements\n1\n1 2 2 0 1 1 2 -3\n$EndElements\n", "msh"),
    "no-such-entity.msh": (
        MSH41
        + "$Entities\n0 0 1 0\n7 0 0 0 1 1 0 0 0\n$EndEntities\n"
        + NODES41
        + CELLS41.replace("2 1 2 2", "2 9 2 2"),
        "msh",
    ),
    "entities-of-1e18.msh": (MSH41 + "$Entities\n1000000000000000000 0 0 0\n$EndEntities\n" + NODES41 + CELLS41, "msh"),
    "blocks-of-1e9.msh": (MSH41 + NODES41.replace("1 4 1 4", "1000000000 4 1 4") + CELLS41, "msh"),
    "nodes-of-1e12.msh": (MSH41 + NODES41.replace("1 4 1 4", "1 1000000000000 1 4") + CELLS41, "msh"),
    "version-9.msh": (MSH.format(version="9.9") + NODES41 + CELLS41, "9.9"),
    "elements-before-nodes.msh": (MSH41 + CELLS41 + NODES41, "msh"),
    "only-points.msh": (MSH41 + NODES41 + "$Elements\n1 1 1 1\n0 1 15 1\n1 1\n$EndElements\n", "no cells"),
    # VTK
    "cells-beyond.vtk": (VTK + "CELLS 1 4\n3 0 1 9\nCELL_TYPES 1\n5\n", "numbers from 0 to 3"),
    "cells-of-1e9.vtk": (VTK + "CELLS 1000000000 4\n3 0 1 2\nCELL_TYPES 1\n5\n", "nothing determines"),
    "negative-size.vtk": (VTK + "CELLS 1 -4\n3 0 1 2\nCELL_TYPES 1\n5\n", "vtk"),
    "type-99.vtk": (VTK + "CELLS 1 4\n3 0 1 2\nCELL_TYPES 1\n99\n", "vtk"),
    "no-types.vtk": (VTK + "CELLS 1 4\n3 0 1 2\n", "vtk"),
    "nan.vtk": (VTK.replace("1 1 0", "nan 1 0") + "CELLS 1 4\n3 0 1 2\nCELL_TYPES 1\n5\n", "point 2"),
    # VTP
    "offsets-that-fall.vtp": (vtp("0 1 2 3", "4 1"), "offsets"),
    "offsets-beyond.vtp": (vtp("0 1 2", "99"), "offsets"),
    "points-beyond.vtp": (vtp("0 1 9"), "vtp"),
    "negative-points.vtp": (vtp("0 1 -1", "3"), "numbers from 0"),
    "coordinates-of-two.vtp": (vtp(points=array("0 0 0 1 0 0 1")), "vtp"),
    "unknown-type.vtp": (vtp(points=array(SQUARE, type="Quaternion")), "type 'Quaternion'"),
    "unknown-format.vtp": (vtp(points=array("!!!", form="binary")), "vtp"),
    "unknown-compressor.vtp": (vtp(more=' compressor="vtkLZ4DataCompressor"'), "vtkLZ4DataCompressor"),
    "appended-and-missing.vtp": (vtp(points=array("", form="appended", more=' offset="0"')), "vtp"),
    "appended-far-behind.vtp": (vtp(points=array("", form="appended", more=' offset="99999999999"')), "vtp"),
    "appended-before.vtp": (vtp(points=array("", form="appended", more=' offset="-5"')), "vtp"),
    "a-fractional-index.vtp": (vtp("0 1 2.5 3"), "vtp"),
    # OFF
    "face-of-1e9.off": (off(SQUARE, "1000000000 0 1 2\n"), "off"),
    "face-of-minus-3.off": (off(SQUARE, "-3 0 1 2\n"), "off"),
    "a-fraction.off": (off(SQUARE, "3 0 1 1.5\n"), "off"),
    "face-twice-a-corner.off": (off(SQUARE, "3 0 1 1\n"), "names a vertex twice"),
    # Files that name others
    "includes-what-lies-outside.inp": (b"*INCLUDE, INPUT=../outside.inp\n", "outside of its folder"),
    "includes-a-device.inp": (b"*INCLUDE, INPUT=/dev/zero\n", "outside of its folder"),
    "includes-what-includes-what-lies-outside.inp": (b"*INCLUDE, INPUT=includes.inp\n", "outside of its folder"),
}
"""By the name of the file."""


def npz(**arrays: np.ndarray | bytes) -> bytes:
    """Members that are arrays, or bytes as they stand."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in arrays.items():
            with packed.open(f"{name}.npy", "w") as member:
                if isinstance(content, bytes):
                    member.write(content)
                else:
                    np.lib.format.write_array(member, content, allow_pickle=True)
    return file.getvalue()


def big() -> bytes:
    """200 MB of zeros in 200 kB."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (2**18, 32, 3)})
    file, zeros = io.BytesIO(), bytes(2**20)
    with (
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed,
        packed.open("positions.npy", "w", force_zip64=True) as member,
    ):
        member.write(head.getvalue())
        for _ in range(192):
            member.write(zeros)
    return file.getvalue()


def frames(name: str) -> str:
    mesh = "mesh: {kind: balloon}, size: 2"
    obstacle = f"{{kind: mesh, {mesh}, frames: {{positions: {name}}}}}"
    return scene(effects=f"[{{kind: springs, stretch: 1}}, {{kind: surface-contact, obstacles: [{obstacle}]}}]")


BALL = np.zeros((2, 42, 3))
ARRAYS: dict[str, tuple[bytes, str]] = {
    "a-bomb.npz": (b"", "at most 100,000,000"),  # made when it is written: see `big`
    "text.npz": (b"positions", "no whole .npz"),
    "an-archive-of-nothing.npz": (npz(), "contains 0 arrays"),
    "a-pickle.npz": (npz(positions=np.array([{}], object)), "type object"),
    "a-pickle-alone.npz": (b"\x80\x04}\x94.", "no whole .npz"),
    "of-another-mesh.npz": (npz(positions=BALL[:, :41]), "41 points for a mesh of 42"),
    "of-two-coordinates.npz": (npz(positions=BALL[:, :, :2]), "(frames, points, 3)"),
    "of-no-frames.npz": (npz(positions=BALL[:0]), "(frames, points, 3)"),
    "far.npz": (npz(positions=BALL + 1e300), "up to 1e+12 m"),
    "a-path-as-a-name.npz": (npz(**{"../../positions": BALL}), "contains 0 arrays"),
    "the-same-twice.npz": (npz(positions=BALL).replace(b"PK\x05\x06", b"PK\x05\x07"), "no whole .npz"),
}
NETWORK = "{kind: network, positions: %s, springs: %s}"
LINE = "[[0, 0, 0], [1, 0, 0]]"


def network(positions: str = LINE, springs: str = "[[0, 1]]", more: str = "") -> str:
    mesh = NETWORK % (positions, springs)
    return scene(mesh=mesh[:-1] + more + "}", effects="[{kind: springs, stretch: 1}]", default_size=None)


def json_scene(**changes: Any) -> str:
    return json.dumps({"obj": "quad.obj", "k": 1.0, "b": [1], **changes})


CONFIGS: dict[str, tuple[str | bytes, str]] = {
    "network-of-no-vertices.yaml": (network("[]", "[]"), "mesh.positions"),
    "network-of-two-coordinates.yaml": (network("[[0, 0], [1, 0]]"), "mesh.positions[0]"),
    "network-of-nan.yaml": (network("[[0, 0, .nan], [1, 0, 0]]"), "mesh.positions[0][2]"),
    "network-far-away.yaml": (network("[[0, 0, 1e300], [1, 0, 0]]"), "mesh.positions[0][2]"),
    "network-beyond-its-vertices.yaml": (network(springs="[[0, 2]]"), "names the vertex 2"),
    "network-from-a-vertex-to-itself.yaml": (network(springs="[[1, 1]]"), "to itself"),
    "network-of-a-fraction.yaml": (network(springs="[[0, 0.5]]"), "mesh.springs[0][1]"),
    "network-of-2e64.yaml": (network(springs=f"[[0, {2**64}]]"), "mesh.springs[0][1]"),
    "network-of-negative-mass.yaml": (network(more=", mass: [1, -1]"), "mesh.mass[1]"),
    "network-of-three-masses.yaml": (network(more=", mass: [1, 1, 1]"), "has 3 masses for 2 vertices"),
    "network-of-100000-springs.yaml": (network(springs="[" + "[0, 1], " * 100_000 + "]"), "large"),
    "a-mesh-in-json-as-a-list.json": ("[" + json_scene() + "]", "json"),
    "an-obj-with-an-alternate-stream.json": (json_scene(obj="quad.obj:x"), "quad.obj:x"),
    "crossed-faces.json": (json_scene(obj="crossed.obj"), "crossed.obj:5"),
    "an-obj-in-a-pointer.json": (json_scene(obj="pointer.obj"), "Git LFS pointer"),
    "a-pointer.json": ("version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "Git LFS pointer"),
    "a-page.json": ("<!doctype html><html></html>", "is a web page"),
    "a-pointer.yaml": ("version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "Git LFS pointer"),
    "a-page.yaml": ("<html></html>", "is a web page"),
    "blanks.yaml": (" \n\n", "is empty"),
    "a-colon.yaml": (scene(description="a: b"), ":7: is not YAML: the value of `description` contains a colon"),
    "a-colon-in-braces.yaml": (scene(mesh="{kind: file, path: a: b.obj}"), "the value of `path` contains a colon"),
    "colons-for-ever.yaml": ("a: " * 50_000, "colon"),
    "an-at-sign.yaml": (scene(description="@home"), "cannot begin with '@'"),
}
OTHER_FILES = {
    "includes.inp": "*INCLUDE, INPUT=../outside.inp\n",
    "crossed.obj": OBJ + "f 1 3 2 4\n",
    "pointer.obj": "version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
    "quad.obj": OBJ + "f 1 2 3\n",
}
