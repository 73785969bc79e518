"""Hostile mesh files: heads alone, counts that are wrong, cuts, odd numbers and indices, other things."""

from __future__ import annotations

import struct

from tests.contracts.hostile import QUAD

XYZ = "property float x\nproperty float y\nproperty float z\n"
FACES = "property list uchar int vertex_indices\n"
POINTS = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


def ply(kind: str = "ascii", vertices: str = "3", faces: str = "1", rest: str = XYZ, body: bytes = b"") -> bytes:
    head = f"ply\nformat {kind} 1.0\nelement vertex {vertices}\n{rest}element face {faces}\n{FACES}end_header\n"
    return head.encode() + body


BINARY = "binary_little_endian"
THREE = b"0 0 0\n1 0 0\n0 1 0\n"
MSH_HEAD = "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n"
MSH_NODES = "$Nodes\n3\n1 0 0 0\n2 1 0 0\n3 0 1 0\n$EndNodes\n"
MSH_CELLS = "$Elements\n1\n1 2 2 0 1 1 2 3\n"
VTK_HEAD = "# vtk DataFile Version 3.0\nx\n"
VTU_HEAD = '<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian">'
ENTITIES = "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in zip("abcdefghi", "bcdefghij", strict=True))
BOMB = f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "{"a" * 100}">{ENTITIES}]>'
READS = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY f SYSTEM "file:///etc/hostname">]>'

MESHES: dict[str, bytes] = {
    # A head alone: readers wait for lines that do not come.
    "head.ply": b"ply\n",
    "head-and-format.ply": b"ply\nformat ascii 1.0\n",
    "no-end-of-head.ply": b"ply\nformat ascii 1.0\nelement vertex 3\n" + XYZ.encode(),
    "head.off": b"OFF",
    "head.bdf": b"BEGIN BULK",
    "head.nas": b"CEND\n",
    "head.msh": b"$MeshFormat\n",
    "head.vtk": VTK_HEAD.encode(),
    "head.inp": b"*NODE\n",
    "head.stl": b"solid",
    "head.vtu": VTU_HEAD.encode(),
    "head.mesh": b"MeshVersionFormatted 2\n",
    "head.su2": b"NDIME= 3\n",
    "head.xdmf": b"<Xdmf>",
    "head.obj": b"v",
    # Counts that the file does not match.
    "claims-1e9-faces.ply": ply(BINARY, faces="1000000000", body=POINTS),
    "claims-1e12-points.ply": ply(BINARY, vertices="1000000000000", body=POINTS),
    "claims-1e30-points.ply": ply(BINARY, vertices="1" + "0" * 30, body=POINTS),
    "claims-negative-faces.ply": ply(BINARY, faces="-1", body=POINTS),
    "claims-words.ply": ply(vertices="many"),
    "face-of-255-of-none.ply": ply(BINARY, body=POINTS + b"\xff"),
    "face-of-zero.ply": ply(body=THREE + b"0\n"),
    "one-point-missing.ply": ply(body=b"0 0 0\n1 0 0\n"),
    "faces-missing.ply": ply(BINARY, faces="2", body=POINTS + struct.pack("<B3i", 3, 0, 1, 2)),
    "claims-1e9.off": b"OFF\n1000000000 1000000000 0\n0 0 0\n",
    "claims-negative.off": b"OFF\n-3 1 0\n0 0 0\n",
    "claims-1e9.stl": bytes(80) + struct.pack("<I", 10**9),
    "claims-4e9-and-half-a-triangle.stl": bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(20),
    "claims-1e12.vtk": (VTK_HEAD + "ASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 1000000000000 float\n0 0 0\n").encode(),
    "claims-1e9-binary.vtk": (VTK_HEAD + "BINARY\nDATASET UNSTRUCTURED_GRID\nPOINTS 1000000000 double\n").encode(),
    "grid-of-1e15.vtk": (
        VTK_HEAD + "ASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 100000 100000 100000\nORIGIN 0 0 0\nSPACING 1 1 1\n"
    ).encode(),
    "claims-1e9.msh": (MSH_HEAD + "$Nodes\n1000000000\n1 0 0 0\n").encode(),
    "claims-1e9.su2": b"NDIME= 2\nNELEM= 1000000000\n5 0 1 2 0\nNPOIN= 3\n",
    # Cut before the end.
    "without-elements.msh": (MSH_HEAD + MSH_NODES).encode(),
    "open-elements.msh": (MSH_HEAD + MSH_NODES + MSH_CELLS).encode(),
    "open-nodes.msh": (MSH_HEAD + MSH_NODES.removesuffix("$EndNodes\n") + MSH_CELLS + "$EndElements\n").encode(),
    "not-ended.stl": b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\n",
    "cut-in-a-number.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1",
    # Numbers and indices.
    "nan.ply": ply(body=b"nan 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
    "infinite.ply": ply(body=b"inf 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"),
    "beyond-float.off": b"OFF\n3 1 0\n1e999 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    "far.off": b"OFF\n3 1 0\n1e300 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    "index-beyond.ply": ply(body=THREE + b"3 0 1 3\n"),
    "index-negative.ply": ply(body=THREE + b"3 0 1 -1\n"),
    "index-beyond-32-bits.off": b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 99999999999\n",
    "index-twice.ply": ply(body=THREE + b"3 0 1 1\n"),
    "no-faces.ply": ply(faces="0", body=THREE),
    "no-points.off": b"OFF\n0 0 0\n",
    "all-in-one-point.ply": ply(body=b"0 0 0\n" * 3 + b"3 0 1 2\n"),
    "words.off": b"OFF\nthree one none\n",
    "one-coordinate.ply": ply(rest="property float x\n", body=b"0\n1\n2\n3 0 1 2\n"),
    "no-coordinates.ply": ply(rest="property float s\n", body=b"0\n1\n2\n3 0 1 2\n"),
    "unknown-type.ply": ply(rest="property quaternion x\n", body=b"0\n1\n2\n"),
    "digits.off": b"OFF\n3 1 0\n" + b"1" * 5000 + b" 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    # Other things under a mesh's name.
    "empty.ply": b"",
    "noise.ply": bytes(range(256)) * 64,
    "noise.vtk": bytes(range(255, -1, -1)) * 64,
    "noise.msh": bytes(range(256)) * 64,
    "noise.stl": bytes(range(256)) * 64,
    "noise.vtu": bytes(range(256)) * 64,
    "noise.bdf": bytes(range(128, 256)) * 64,
    "noise.h5m": bytes(range(256)) * 64,
    "noise.xyz": b"what is this",
    "no-suffix": b"ply\n",
    "entities.vtu": (BOMB + VTU_HEAD + "&j;</VTKFile>").encode(),
    "entities.xdmf": (BOMB + "<Xdmf>&j;</Xdmf>").encode(),
    "reads-a-file.vtu": (READS + VTU_HEAD + "&f;</VTKFile>").encode(),
    "includes.inp": b"*INCLUDE, INPUT=/dev/zero\n",
    "includes-itself.inp": b"*INCLUDE, INPUT=includes-itself.inp\n",
    "names-another-file.xdmf": (
        b'<Xdmf Version="3.0"><Domain><Grid><Geometry GeometryType="XYZ"><DataItem Dimensions="3 3" Format="HDF" '
        b'DataType="Float">/dev/zero:/x</DataItem></Geometry></Grid></Domain></Xdmf>'
    ),
    "deep.vtu": b"<a>" * 200_000,
    "face-of-100000.obj": (QUAD + "f " + " ".join(["1", "2", "3"] * 33_333) + "\n").encode(),
    "line-of-one.obj": (QUAD + "l 1\n").encode(),
    "index-of-5000-digits.obj": (QUAD + "f 1 2 " + "9" * 5000 + "\n").encode(),
    "curve.obj": (QUAD + "curv 0 1 1 2 3\n").encode(),
}
"""Files by name; a scene that takes its mesh from one is refused, and the message names the file."""
