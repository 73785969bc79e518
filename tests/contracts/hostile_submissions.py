"""Hostile input of the commands on others' positions, matrices, meshes, settings and published results.

Each case: the command line, its exit code, and what the answer must name. `FILES` are the files that they read, `LINKS`
links in the same folder. A code of None is 0 or 1: the input is odd, but can be answered.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from tests.contracts.hostile import QUAD, scene, sweep
from tests.contracts.hostile_readers import npz

NUM_VERTICES = 16
"""Of the grid of `good.yaml`."""
AT_REST = np.zeros((3, NUM_VERTICES, 3))
BIG = 8_000_000


class CommandCase(NamedTuple):
    """A command line, its exit code, and words of its answer."""

    line: str
    code: int | None
    words: str


def npy(values: np.ndarray, head: str = "") -> bytes:
    """An .npy file; `head` replaces the description of its array."""
    described = {"descr": np.lib.format.dtype_to_descr(values.dtype), "fortran_order": False, "shape": values.shape}
    text = (head or repr(described)).encode()
    text += b" " * (63 - (len(text) + 10) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + values.tobytes()


def long_table(*lines: str, names: str = "frame,vertex,x,y,z") -> str:
    """A table of one line a vertex; by default of one frame at the origin, and then the lines."""
    return "\n".join((names, *(f"1,{k},0,0,0" for k in range(1, NUM_VERTICES)), *lines)) + "\n"


WIDE = ",".join(["0.5"] * 3 * NUM_VERTICES) + "\n"
OBJ_16 = "".join(f"v {k % 4} {k // 4} 0\n" for k in range(NUM_VERTICES))
MTX = "%%MatrixMarket matrix coordinate real general\n"
ARRAY_MTX = "%%MatrixMarket matrix array real general\n"
STUDY: dict[str, Any] = {
    "config": "../../good.yaml",
    "is_timed": False,
    "runs": 1,
    "duration_seconds": 1,
    "machines": [{"cpu": "a", "cores": 1}],
    "command": "springbench run good.yaml",
    "files": {},
}


def study(**changes: Any) -> str:
    """The description of a published study, some keys changed or (None) left out."""
    return json.dumps({key: value for key, value in (STUDY | changes).items() if value is not None})


FILES: dict[str, str | bytes | Callable[[], str | bytes]] = {
    "good.yaml": scene(),
    "sweep.yaml": sweep(),
    "quad.obj": QUAD + "f 1 2 3\n",
    "file.yaml": scene(mesh="{kind: file, path: quad.obj}", effects="[{kind: springs, stretch: 1}]"),
    "fine.npz": npz(positions=AT_REST),
    # positions
    "empty.npz": b"",
    "text.npz": "positions",
    "pickled.npz": npz(positions=np.array([{}], object)),
    "other-name.npz": npz(**{"../../positions": AT_REST}),
    "nothing-finite.npz": npz(positions=AT_REST + np.nan),
    "beyond-squares.npz": npz(positions=AT_REST + 1e200),
    "vast.npz": npz(positions=AT_REST + 1e99),
    "alternating.npz": npz(positions=AT_REST + np.array([1e99, -1e99, 1e99])[:, None, None]),
    "subnormal.npz": npz(positions=AT_REST + 5e-324),
    "no-frames.npz": npz(positions=AT_REST[:0]),
    "four-axes.npz": npz(positions=AT_REST[None]),
    "a-number.npz": npz(positions=np.array(7.0)),
    "of-15.npz": npz(positions=AT_REST[:, :15]),
    "bomb.npz": lambda: npz(positions=np.zeros((2**18, 32, 3))),
    "complex.npy": npy(AT_REST + 0j),
    "texts.npy": npy(np.full((3, 16, 3), "0")),
    "booleans.npy": npy(AT_REST > 0),
    "integers.npy": npy(AT_REST.astype(np.int8)),
    "fields.npy": npy(np.zeros(3, [("x", "f8"), ("y", "f8")])),
    "promises-1e12.npy": npy(AT_REST, "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 16, 3)}"),
    "shape-below-0.npy": npy(AT_REST, "{'descr': '<f8', 'fortran_order': False, 'shape': (-3, 16, 3)}"),
    "head-of-code.npy": npy(AT_REST, "__import__('os').system('touch pwned')"),
    "head-alone.npy": npy(AT_REST)[:60],
    "empty.csv": "",
    "comments.csv": "# nothing\n" * 3,
    "nul.csv": "0,0\0,0\n",
    "utf-16.csv": WIDE.encode("utf-16"),
    "not-finite.csv": WIDE.replace("0.5", "nan"),
    "beyond-floats.csv": WIDE.replace("0.5", "1e999"),
    "5000-digits.csv": WIDE.replace("0.5", "9" * 5000),
    "other-digits.csv": WIDE.replace("0.5", "٣"),
    "two-heads.csv": "x,y\nx,y\n" + WIDE,
    "one-line-of-8-MB.csv": lambda: "0," * (BIG // 2) + "0\n",
    "lines-of-8-MB.csv": lambda: "0\n" * (BIG // 2),
    "a-word-of-8-MB.csv": lambda: "x" * BIG,
    "half-a-vertex.csv": long_table("1,0.5,0,0,0"),
    "vertex-of-nan.csv": long_table("1,nan,0,0,0"),
    "vertex-of-1e300.csv": long_table("1,1e300,0,0,0"),
    "vertex-below-0.csv": long_table("1,-1,0,0,0"),
    "vertex-twice.csv": long_table("1,1,0,0,0"),
    "frame-of-nan.csv": long_table("nan,16,0,0,0"),
    "frames-of-1e300.csv": long_table("1e300,16,0,0,0"),
    "half-a-frame.csv": long_table("1,16,0,0,0").replace("\n1,", "\n1.5,"),
    "a-frame-of-nan.csv": f"frame,{','.join(f'c{k}' for k in range(48))}\nnan,{WIDE}",
    "frames-apart.csv": f"frame,{','.join(f'c{k}' for k in range(48))}\n1,{WIDE}7,{WIDE}",
    "frame-below-0.csv": f"frame,{','.join(f'c{k}' for k in range(48))}\n-1,{WIDE}",
    "a-time-of-nan.csv": f"time,{','.join(f'c{k}' for k in range(48))}\nnan,{WIDE}",
    "frame-twice.csv": f"frame,frame,{','.join(f'c{k}' for k in range(48))}\n1,1,{WIDE}",
    "empty.rrd": b"",
    "text.rrd": "recording",
    "head.rrd": b"RRF2" + bytes(1000),
    "folder-of-nothing/readme.md": "",
    "folder-without-numbers/first.obj": OBJ_16,
    "folder-with-a-gap/1.obj": OBJ_16,
    "folder-with-a-gap/9.obj": OBJ_16,
    "folder-of-one-number/1.obj": OBJ_16,
    "folder-of-one-number/a1.obj": OBJ_16,
    "folder-of-long-numbers/" + "9" * 200 + ".obj": OBJ_16,
    "folder-of-sizes/1.obj": OBJ_16,
    "folder-of-sizes/2.obj": QUAD,
    "folder-of-broken/1.obj": "v 0 0\n",
    "folder-of-broken-ply/1.ply": "ply\n",
    "folder-of-promises/1.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999\nproperty float x\n"
    b"property float y\nproperty float z\nend_header\n",
    "class/[red]evil[/red].npz": b"",
    "class/=SUM(A1).csv": "1,2\n",
    "class/..npz": b"",
    "class/deep/deep/1.npz": b"",
    "two-frames.npz": npz(positions=AT_REST[:2]),
    "rest-of-nan.npz": npz(positions=AT_REST[:1] + np.nan),
    "one-place.npz": npz(positions=AT_REST[:1]),
    # matrices
    "empty/Q.mtx": "",
    "text/Q.mtx": "matrix",
    "head/Q.mtx": MTX,
    "short/Q.mtx": MTX + "16 16 3\n1 1 1.0\n",
    "long/Q.mtx": MTX + "16 16 1\n1 1 1.0\n2 2 1.0\n",
    "beyond/Q.mtx": MTX + "16 16 1\n17 1 1.0\n",
    "zeroth/Q.mtx": MTX + "16 16 1\n0 1 1.0\n",
    "of-1e9/Q.mtx": MTX + "1000000000 1000000000 1\n1 1 1.0\n",
    "of-1e12-entries/Q.mtx": MTX + "16 16 1000000000000\n1 1 1.0\n",
    "dense-of-1e9/Q.mtx": ARRAY_MTX + "1000000000 1000000000\n1.0\n",
    "below-0/Q.mtx": ARRAY_MTX + "-16 -16\n",
    "of-nan/Q.mtx": ARRAY_MTX + "16 16\n" + "nan\n" * 256,
    "of-1e999/Q.mtx": ARRAY_MTX + "16 16\n" + "1e999\n" * 256,
    "complex/Q.mtx": MTX.replace("real", "complex") + "16 16 1\n1 1 1.0 2.0\n",
    "pattern/Q.mtx": MTX.replace("real", "pattern") + "16 16 1\n1 1\n",
    "hermitian/Q.mtx": MTX.replace("general", "hermitian") + "16 16 1\n1 2 1.0\n",
    "twice/Q.mtx": MTX + "16 16 2\n1 1 1.0\n1 1 1.0\n",
    "vector/b.mtx": ARRAY_MTX + "16 1\n" + "0\n" * 16,
    "no-matrix.mtx": MTX,
    # meshes
    "one-point.obj": "v 0 0 0\n",
    "one-place.obj": "v 1 1 1\n" * 40_000 + "f 1 2 3\n",
    "a-line.obj": "".join(f"v {k} 0 0\n" for k in range(3000))
    + "".join(f"f {k} {k + 1} {k + 2}\n" for k in range(1, 2999)),
    "a-fan.obj": "v 0 0 0\nv 0 0 1\n"
    + "".join(f"v {np.cos(a):.9f} {np.sin(a):.9f} 0\nf 1 2 {k + 3}\n" for k, a in enumerate(np.linspace(0, 6, 3000))),
    "tangled.obj": "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in np.random.default_rng(0).random((1200, 3)))
    + "".join(f"f {3 * k + 1} {3 * k + 2} {3 * k + 3}\n" for k in range(400)),
    "on-one-edge.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    + "".join(f"v {(k + 1) / 20_001:.12f} 0 0\n" for k in range(20_000)),
    "tiny.obj": "v 0 0 0\nv 1e-300 0 0\nv 0 1e-300 0\nf 1 2 3\n",
    "vast.obj": "v 0 0 0\nv 1e12 0 0\nv 0 1e12 0\nf 1 2 3\n",
    "flat.obj": "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
    "[bold]x.obj": QUAD + "f 1 2 3\nf 1 3 2\n",
    "group-of-escapes.obj": "g \x1b[31mred \x1b]0;title\x07\n" + QUAD + "f 1 2 3\n",
    # published studies
    "deep/x/study.json": "[" * 100_000,
    "a-list/x/study.json": "[]",
    "null/x/study.json": "null",
    "no-text/x/study.json": bytes(range(128, 256)),
    "no-config/x/study.json": study(config=None),
    "no-machines/x/study.json": study(machines=[]),
    "no-duration/x/study.json": study(duration_seconds=None),
    "duration-of-words/x/study.json": study(duration_seconds="long"),
    "duration-of-nan/x/study.json": study(duration_seconds=1).replace(
        '"duration_seconds": 1', '"duration_seconds": NaN'
    ),
    "no-runs/x/study.json": study(runs=None),
    "machine-of-words/x/study.json": study(machines=["EPYC"]),
    "files-outside/x/study.json": study(files={"../../good.yaml": "0" * 64, "/etc/hostname": "0" * 64}),
    "files-of-numbers/x/study.json": study(files={"runs.parquet": 7}),
    "config-of-a-device/x/study.json": study(config="/dev/zero"),
    "config-of-nul/x/study.json": study(config="a\0b.yaml"),
    "config-far-away/x/study.json": study(config="../" * 5000 + "etc/passwd"),
    "40-mb/x/study.json": lambda: study(config="x" * 40_000_000),
    "text-table/x/study.json": study(),
    "text-table/x/runs.parquet": "PAR1 no table PAR1",
    "fine/x/study.json": study(),
    "published-file": "",
    "entries/entries/text.zip": "no archive",
    "odd/rows/a.parquet": "no rows",
    "odd/owner.txt": "x" * 10_000,
    "empty-results/readme.md": "",
    "measurements.parquet": "no table",
}
"""Files by their paths; a function makes what is large."""

LINKS = {
    "device.csv": "/dev/zero",
    "device.npz": "/dev/zero",
    "device.rrd": "/dev/zero",
    "device/Q.mtx": "/dev/zero",
    "loop.csv": "loop.csv",
    "device.obj": "/dev/zero",
    "folder-of-a-device/1.obj": "/dev/zero",
    "study-device/x/study.json": "/dev/zero",
}
PIPES = (
    "pipe.csv",
    "pipe.npz",
    "pipe.npy",
    "pipe.rrd",
    "pipe/Q.mtx",
    "pipe.obj",
    "class/pipe.csv",
    "study-pipe/x/study.json",
)

_SUBMISSION_MESSAGES = {
    # name of the file: exit code, words
    "empty.npz": (2, "empty"),
    "text.npz": (2, "no whole .npz"),
    "pickled.npz": (2, "type object"),
    "other-name.npz": (2, "contains 0 arrays"),
    "nothing-finite.npz": (2, "no frame of finite positions"),
    "beyond-squares.npz": (2, "no frame of finite positions"),
    "vast.npz": (None, "residual"),
    "alternating.npz": (None, "residual"),
    "subnormal.npz": (None, "residual"),
    "no-frames.npz": (2, "no frames"),
    "four-axes.npz": (2, "shape (1, 3, 16, 3)"),
    "a-number.npz": (2, "shape (1,)"),
    "of-15.npz": (2, "has 15 vertices; the scene has 16"),
    "bomb.npz": (2, "at most 100,000,000"),
    "complex.npy": (2, "complex128"),
    "texts.npy": (2, "expected real numbers"),
    "booleans.npy": (2, "expected real numbers"),
    "integers.npy": (None, "residual"),
    "fields.npy": (2, "expected real numbers"),
    "promises-1e12.npy": (2, "declares"),
    "shape-below-0.npy": (2, "shape"),
    "head-of-code.npy": (2, "no head of an array"),
    "head-alone.npy": (2, "no head of an array"),
    "empty.csv": (2, "is empty"),
    "comments.csv": (2, "no frames"),
    "nul.csv": (2, "nul.csv"),
    "utf-16.csv": (2, "cannot be read as text"),
    "not-finite.csv": (2, "no frame of finite positions"),
    "beyond-floats.csv": (2, "no frame of finite positions"),
    "5000-digits.csv": (2, "more than 3,200 characters"),
    "other-digits.csv": (None, "residual"),
    "two-heads.csv": (2, "two-heads.csv:2"),
    "one-line-of-8-MB.csv": (2, "expected at most 50 numbers"),
    "lines-of-8-MB.csv": (2, "expected one line a frame of 48 numbers"),
    "a-word-of-8-MB.csv": (2, "more than 3,200 characters"),
    "half-a-vertex.csv": (2, "whole number"),
    "vertex-of-nan.csv": (2, "whole number"),
    "vertex-of-1e300.csv": (2, "whole number"),
    "vertex-below-0.csv": (2, "vertices once"),
    "vertex-twice.csv": (2, "vertex 1 2 times"),
    "frame-of-nan.csv": (2, "whole number"),
    "frames-of-1e300.csv": (2, "whole number"),
    "half-a-frame.csv": (2, "whole number"),
    "a-frame-of-nan.csv": (2, "whole number"),
    "frames-apart.csv": (2, "not consecutive"),
    "frame-below-0.csv": (2, "begins with frame -1"),
    "a-time-of-nan.csv": (2, "expected seconds"),
    "frame-twice.csv": (2, "twice"),
    "empty.rrd": (2, "empty.rrd"),
    "text.rrd": (2, "text.rrd"),
    "head.rrd": (2, "head.rrd"),
    "folder-of-nothing": (2, "has no .obj or .ply files"),
    "folder-without-numbers": (2, "has no number"),
    "folder-with-a-gap": (2, "files 1 and 9 in a row"),
    "folder-of-one-number": (2, "files 1 and 1 in a row"),
    "folder-of-long-numbers": (None, "residual"),
    "folder-of-sizes": (2, "3 vertices, and 1.obj has 16"),
    "folder-of-broken": (2, "needs 3 coordinates"),
    "folder-of-broken-ply": (2, "no head"),
    "folder-of-promises": (2, "declares 999,999,999"),
    "folder-of-a-device": (2, "has no .obj or .ply files"),
    "device.csv": (2, "no file"),
    "device.npz": (2, "no file"),
    "device.rrd": (2, "no such file"),
    "loop.csv": (2, "loop.csv"),
    "pipe.csv": (2, "no file"),
    "pipe.npz": (2, "no file"),
    "pipe.npy": (2, "no file"),
    "pipe.rrd": (2, "no such file"),
    "good.yaml": (2, "suffix '.yaml'"),
    "published-file": (2, "suffix ''"),
}
GRADE_CASES = {
    name: CommandCase(f"grade {name} good.yaml --budget 1", *found) for name, found in _SUBMISSION_MESSAGES.items()
}

_FINE = "grade fine.npz good.yaml --budget 1"
OPTIONS = {
    "a budget of nan": CommandCase("grade fine.npz good.yaml --budget nan", 2, "--budget"),
    "a budget below zero": CommandCase("grade fine.npz good.yaml --budget -1", 2, "--budget"),
    "a thousand and one iterations": CommandCase(f"{_FINE} --iterations 1001", 2, "--iterations"),
    "iterations of 5000 digits": CommandCase(f"{_FINE} --iterations {'9' * 5000}", 2, "--iterations"),
    "a first frame of 2": CommandCase(f"{_FINE} --first-frame 2", 2, "--first-frame"),
    "an array of a path": CommandCase(f"{_FINE} --array ../../etc/passwd", 2, "contains 0 arrays"),
    "an array of no name": CommandCase(f"{_FINE} --array ''", 2, "contains 0 arrays"),
    "rest of two frames": CommandCase(f"{_FINE} --rest two-frames.npz", 2, "2 frames; expected one"),
    "rest of nan": CommandCase(f"{_FINE} --rest rest-of-nan.npz", 2, "rest"),
    "rest in one place": CommandCase(f"{_FINE} --rest one-place.npz", 2, "one to one"),
    "rest of another mesh": CommandCase(f"{_FINE} --rest quad.obj", 2, "3 vertices; the scene has 16"),
    "rest of a device": CommandCase(f"{_FINE} --rest device.obj", 2, "device.obj"),
    "rest of a pipe": CommandCase(f"{_FINE} --rest pipe.obj", 2, "pipe.obj"),
    "a table into no folder": CommandCase(f"{_FINE} --csv none/x.csv", 2, "--csv"),
    "a table into a device": CommandCase(f"{_FINE} --csv /dev/full", 2, "--csv"),
    "a table into a pipe": CommandCase(f"{_FINE} --csv pipe.csv", 2, "--csv"),
    "a table over a link to a device": CommandCase(f"{_FINE} --csv device.csv", 2, "--csv"),
    "students of odd names": CommandCase("grade class good.yaml --students --budget 1", 0, "not graded"),
    "students of a file": CommandCase("grade fine.npz good.yaml --students", 2, "--students"),
    "positions for a sweep": CommandCase("grade fine.npz sweep.yaml", 2, "sweep.yaml"),
    "positions for a device": CommandCase("grade fine.npz /dev/zero", 2, "/dev/zero"),
    "positions of size 1e9": CommandCase(f"{_FINE} --size 1000000000", 2, "size"),
    "matrices of size 1e9": CommandCase("matrices good.yaml --size 1000000000", 2, "size"),
    "matrices of size -1": CommandCase("matrices good.yaml --size -1", 2, "size"),
    "matrices of frame 1e9": CommandCase("matrices good.yaml --frame 1000000000", 2, "--frame"),
    "matrices into a file": CommandCase("matrices good.yaml -o good.yaml", 2, "--output"),
    "matrices into a device": CommandCase("matrices good.yaml -o /dev/null", 2, "--output"),
    "matrices into /proc": CommandCase("matrices good.yaml -o /proc/self/x", 2, "/proc"),
    "a mesh of a device": CommandCase("mesh /dev/zero", 2, "/dev/zero"),
    "a mesh of a linked device": CommandCase("mesh device.obj", 2, "device.obj"),
    "a mesh of a pipe": CommandCase("mesh pipe.obj", 2, "pipe.obj"),
    "a mesh of a folder": CommandCase("mesh .", 2, "."),
    "a mesh of a scene without a file": CommandCase("mesh good.yaml", 2, "names no mesh file"),
    "a mesh of a sweep": CommandCase("mesh sweep.yaml", 2, "sweep.yaml"),
    "a scale of nan": CommandCase("mesh quad.obj --scale nan", 2, "--scale"),
    "a scale of zero": CommandCase("mesh quad.obj --scale 0", 2, "--scale"),
    "a scale below zero": CommandCase("mesh quad.obj --scale -1", 2, "--scale"),
    "a scale of 1e300": CommandCase("mesh quad.obj --scale 1e300", 2, "scale"),
    "a scale and units": CommandCase("mesh quad.obj --scale 2 --units mm", 2, "units"),
    "units of parsecs": CommandCase("mesh quad.obj --units parsec", 2, "--units"),
    "a fourth axis": CommandCase("mesh quad.obj --up w", 2, "--up"),
    "a weld of nan": CommandCase("mesh quad.obj --weld nan", 2, "--weld"),
    "a weld below zero": CommandCase("mesh quad.obj --weld -1", 2, "--weld"),
    "a weld of everything": CommandCase("mesh quad.obj --weld 1e9", 0, "vertex twice"),
    "a weld of one place": CommandCase("mesh one-place.obj --weld 0.1", 2, "weld"),
    "an unknown rule of faces": CommandCase("mesh quad.obj --faces all", 2, "--faces"),
    "a picture into no folder": CommandCase("mesh quad.obj -o none/x.png", 2, "--output"),
    "a picture into a device": CommandCase("mesh quad.obj -o /dev/full", 2, "--output"),
    "a picture of another kind": CommandCase("mesh quad.obj -o x.gif", 2, "--output"),
    "one point": CommandCase("mesh one-point.obj --json", 0, "one-point.obj"),
    "40000 points in one place": CommandCase("mesh one-place.obj --json", None, "one-place.obj"),
    "faces in a line": CommandCase("mesh a-line.obj --json", None, "flat"),
    "a fan of 3000 faces": CommandCase("mesh a-fan.obj --json", None, "non-manifold"),
    "400 faces through each other": CommandCase("mesh tangled.obj --json", None, "self-intersections"),
    "20000 points on one edge": CommandCase("mesh on-one-edge.obj --json", None, "unused-vertices"),
    "a mesh of 1e-300 m": CommandCase("mesh tiny.obj --json", None, "tiny.obj"),
    "a mesh of 1e12 m": CommandCase("mesh vast.obj --json", None, "vast.obj"),
    "a mesh without area": CommandCase("mesh flat.obj --json", None, "flat.obj"),
    "a mesh of a marked name": CommandCase("mesh '[bold]x.obj'", 0, "[bold]x.obj"),
    "a group of escapes": CommandCase("mesh group-of-escapes.obj", 0, "red"),
    "no such solver": CommandCase("convergence good.yaml --solver ./mine.py:Mine", 2, "--solver"),
    "substeps of 30 digits": CommandCase(
        f"convergence good.yaml --solver sparse --setting {'9' * 30}x5", 2, "--setting"
    ),
    "substeps below zero": CommandCase("convergence good.yaml --solver sparse --setting=-1x5", 2, "--setting"),
    "iterations of 30 digits": CommandCase(
        f"convergence good.yaml --solver sparse --setting 2x{'9' * 30}", 2, "--setting"
    ),
    "an error of nan": CommandCase("convergence good.yaml --solver sparse --error nan", 2, "--error"),
    "an error of infinity": CommandCase("convergence good.yaml --solver sparse --error inf", 2, "--error"),
    "an end of infinity": CommandCase("convergence good.yaml --solver sparse --t-end inf", 2, "--t-end"),
    "an end of zero": CommandCase("convergence good.yaml --solver sparse --t-end 0", 2, "--t-end"),
    "a limit of nan": CommandCase("convergence good.yaml --solver sparse --time-limit nan", 2, "--time-limit"),
    "a search without end": CommandCase("convergence good.yaml --solver sparse --search-time inf", 2, "--search-time"),
    "a parameter of code": CommandCase(
        "convergence good.yaml --solver lbfgs --parameter 'history_size=!!python/object/apply:os.getcwd []'",
        2,
        "history_size",
    ),
    "a parameter of no key": CommandCase("convergence good.yaml --solver sparse --parameter =3", 2, "--parameter"),
    "a parameter of brackets": CommandCase(
        f"convergence good.yaml --solver lbfgs --parameter history_size={'[' * 5000}", 2, "--parameter"
    ),
    "an integrator of no such name": CommandCase("convergence good.yaml --solver sparse --integrator rk4", 2, "rk4"),
    "a setting of a sweep": CommandCase("convergence sweep.yaml --solver sparse", 2, "sweep.yaml"),
    "a setting in a file": CommandCase("convergence good.yaml --solver sparse --results good.yaml", 2, "good.yaml"),
    "a budget of no unit": CommandCase("recommend good.yaml --budget 4", 2, "--budget"),
    "a budget of nan ms": CommandCase("recommend good.yaml --budget nanms", 2, "--budget"),
    "a budget of two units": CommandCase("recommend good.yaml --budget 4mss", 2, "--budget"),
    "a budget and an error": CommandCase("recommend good.yaml --budget 4ms --error .1", 2, "recommend"),
    "a case of no such name": CommandCase("validate --case ../../etc/passwd", 2, "--case"),
    "a page in a file": CommandCase("validate --case 'hanging chain' -o good.yaml", 2, "good.yaml"),
    "a new study over a file": CommandCase("new good.yaml", 2, "good.yaml"),
    "a new study over another": CommandCase("new class", 2, "empty folder"),
    "a new study in /proc": CommandCase("new /proc/self/x", 2, "/proc"),
    "a new study of a long name": CommandCase(f"new {'x' * 300}", 2, "too long"),
}

_MATRICES = {
    "empty/Q.mtx": "cannot be read",
    "text/Q.mtx": "cannot be read",
    "head/Q.mtx": "cannot be read",
    "short/Q.mtx": "cannot be read",
    "long/Q.mtx": "cannot be read",
    "beyond/Q.mtx": "cannot be read",
    "zeroth/Q.mtx": "cannot be read",
    "of-1e9/Q.mtx": "has the shape",
    "of-1e12-entries/Q.mtx": "cannot be read",
    "dense-of-1e9/Q.mtx": "cannot be read",
    "below-0/Q.mtx": "Q.mtx",
    "complex/Q.mtx": "expected real numbers",
    "of-nan/Q.mtx": "finite",
    "of-1e999/Q.mtx": "finite",
    "device/Q.mtx": "no such file",
    "pipe/Q.mtx": "no such file",
    "vector/b.mtx": "has the shape (16, 1)",
    "no-matrix.mtx": "should be named",
    "none/Q.mtx": "no such file",
    "good.yaml": "should be named",
}
MATRICES = {
    name: CommandCase(f"matrices good.yaml -o out --compare {name}", 2, words) for name, words in _MATRICES.items()
}
MATRICES |= {
    name: CommandCase(f"matrices good.yaml -o out --compare {name}", 0, "differs most")
    for name in ("pattern/Q.mtx", "hermitian/Q.mtx", "twice/Q.mtx")
}

_STUDIES = {
    "deep": "describes no study",
    "a-list": "describes no study",
    "null": "describes no study",
    "no-text": "describes no study",
    "no-config": "describes no study",
    "no-machines": "describes no study",
    "no-duration": "describes no study",
    "duration-of-words": "describes no study",
    "duration-of-nan": "describes no study",
    "no-runs": "describes no study",
    "machine-of-words": "describes no study",
    "files-outside": "describes no study",
    "files-of-numbers": "describes no study",
    "config-of-a-device": "x",
    "config-of-nul": "describes no study",
    "config-far-away": "describes no study",
    "40-mb": "describes no study",
    "text-table": "differs from its checksum",
    "study-device": "describes no study",
    "study-pipe": "describes no study",
    "published-file": "no published studies",
    "none": "no published studies",
}
STUDIES = {name: CommandCase(f"reproduce x --published {name}", 2, words) for name, words in _STUDIES.items()}
STUDIES |= {
    "a study of a path": CommandCase("reproduce ../../x --published fine", 2, "STUDY"),
    "a study without a table": CommandCase("reproduce x --published fine", 2, "x"),
    "a seed alone": CommandCase("reproduce x --published fine --seed 1", 2, "--seed"),
    "workers of -1": CommandCase("reproduce x --published fine --workers -1", 2, "--workers"),
    "repeated into a file": CommandCase("reproduce x --published fine --results good.yaml", 2, "good.yaml"),
    "entries of text": CommandCase("reproduce entries --published entries", 2, "text.zip"),
    "a comparison of a file": CommandCase("compare good.yaml --published fine", 2, "good.yaml"),
    "a comparison of nothing": CommandCase("compare empty-results --published fine", 2, "no rows"),
    "a comparison of no rows": CommandCase("compare odd --published fine", 2, "odd"),
    "a comparison with a damaged study": CommandCase("compare odd --published deep", 2, "describes no study"),
    "a study of nothing": CommandCase("publish-study none", 2, "none"),
    "a study of no config": CommandCase("publish-study empty-results", 2, "--config"),
    "a study of a missing config": CommandCase("publish-study empty-results --config none.yaml", 2, "none.yaml"),
    "a study of a device": CommandCase("publish-study /dev/zero --config good.yaml", 2, "/dev/zero"),
    "a study of odd rows": CommandCase("publish-study odd --config sweep.yaml --published new-set", 2, "odd"),
    "a study of no table": CommandCase(
        "publish-study measurements.parquet --config sweep.yaml --published new-set", 2, "measurements.parquet"
    ),
    "a study into a file": CommandCase(
        "publish-study empty-results --config sweep.yaml --published good.yaml", 2, "rows"
    ),
    "a study by a text": CommandCase(
        "publish-study odd --config sweep.yaml --provenance good.yaml --published new-set", 2, ""
    ),
}

CASES = {**GRADE_CASES, **OPTIONS, **MATRICES, **STUDIES}
