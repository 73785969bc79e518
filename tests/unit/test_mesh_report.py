"""Reports on mesh files: each fault is found, named by its place, and reported with its remedy."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from springbench.harness.cli.main import app
from springbench.harness.report import opengl_probe
from springbench.harness.scenes.mesh.file_mesh import FileMesh
from springbench.harness.scenes.mesh.mesh_checks import guess_unit
from springbench.harness.scenes.mesh.mesh_report import build_mesh_report, format_finding
from typer.testing import CliRunner

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
CLEAN = f"{SQUARE}f 1 2 3 4\n"
OCTAHEDRON = "v 1 0 0\nv -1 0 0\nv 0 1 0\nv 0 -1 0\nv 0 0 1\nv 0 0 -1\n" + "".join(
    f"f {face}\n" for face in ("1 3 5", "3 2 5", "2 4 5", "4 1 5", "3 1 6", "2 3 6", "4 2 6", "1 4 6")
)
MOEBIUS = "".join(
    f"v {(1 + s * np.cos(a / 2)) * np.cos(a)} {(1 + s * np.cos(a / 2)) * np.sin(a)} {s * np.sin(a / 2)}\n"
    for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)
    for s in (-0.3, 0.3)
) + "".join(f"f {2 * k + 1} {2 * k + 2} {2 * k + 4} {2 * k + 3}\n" for k in range(7)) + "f 15 16 1 2\n"  # fmt: skip

FAULTS = {
    "units": ("v 0 0 0\nv 1414 0 0\nv 0 1414 0\nf 1 2 3\n", "1,414 m wide", "`scale: 0.001`"),
    "far-from-origin": (
        "v 3e7 0 0\nv 30000001 0 0\nv 3e7 1 0\nf 1 2 3\n",
        "3e+07 m from the origin and 1 m large",
        "subtract an offset",
    ),
    "coincident-vertices": (
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 4 5 6\n",
        "2 (vertex 2, 3, 4, 6)",
        "`weld: 0`",
    ),
    "near-vertices": (
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1.003 0 0\nv 1 1 0\nv 0 1.001 0\nf 1 2 3\nf 4 5 6\n",
        "at most 0.003 m apart (a seam?): 2 (vertex 2, 3, 4, 6)",
        "`weld: 0.004`",
    ),
    "t-junctions": (
        "v 0 0 0\nv 2 0 0\nv 1 2 0\nv 1 0 0\nv 1 -1 0\nf 1 2 3\nf 4 1 5\nf 2 4 5\n",
        "(edge 1-2; vertex 4)",
        "split",
    ),
    "unused-vertices": (f"{SQUARE}v 1 2 0\nf 1 2 3 4\n", ": 1 (vertex 5)", "`unused: drop`"),
    "repeated-corners": (f"{SQUARE}f 1 2 3 4\nf 1 3 3\n", ": 1 (line 6)", "drop-degenerate"),
    "flat-faces": (f"{SQUARE}v 0.5 0 0\nf 1 2 3 4\nf 1 5 2\n", ": 1 (line 7)", "drop-degenerate"),
    "duplicate-faces": (f"{SQUARE}f 1 2 3 4\nf 4 3 2 1\nf 1 2 3\n", ": 2 (line 6, 7)", ""),
    "crossed-faces": (f"{SQUARE}f 1 2 4 3\nf 1 2 3\n", ": 1 (line 5)", "in order"),
    "flipped-triangles": (
        f"{SQUARE}v 2 0 0\nv 2 1 0\nf 1 2 3 4\nf 2 5 3\nf 3 5 6\nf 1 2 5\nv 3 0 0\nf 5 6 7\n",
        ": 1 (triangle 5-6-7)",
        "normals",
    ),
    "inside-out": ("".join(line + "\n" if line[0] == "v" else "f " + " ".join(line.split()[:0:-1]) + "\n"
                           for line in OCTAHEDRON.splitlines()), "inwards", "flip"),
    "one-sided": (MOEBIUS, "one side", "two sides"),
    "non-manifold-edges": (f"{SQUARE}v 0.5 0.5 1\nf 1 2 3\nf 1 3 4\nf 1 3 5\n", "1 (edge 1-3)", ""),
    "pinched-vertices": ("v 0 0 0\nv 1 0 0\nv 1 1 0\nv -1 0 0\nv -1 -1 0\nf 1 2 3\nf 1 4 5\n", "1 (vertex 1)", ""),
    "slivers": ("v 0 0 0\nv 1 0 0\nv 0.5 0.001 0\nf 1 2 3\n", ": 1 (triangle 1-2-3)", "remesh"),
    "short-edges": (f"{SQUARE}v 1 1.001 0\nv 2 1 0\nf 1 2 3 4\nf 3 6 5\n", ": 1 (edge 3-5)", "`weld: 0.001`"),
    "self-intersections": (
        f"{SQUARE}v 0.5 0.2 -1\nv 0.5 0.2 1\nv 0.7 0.2 -1\nf 1 2 3\nf 1 3 4\nf 5 6 7\n",
        "triangle 1-2-3",
        "`self-contact`",
    ),
}  # fmt: skip


def write(folder: Path, text: str) -> Path:
    """An OBJ file with this text."""
    path = folder / "mesh.obj"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_found_with_its_place_and_remedy(tmp_path, name):
    text, place, remedy = FAULTS[name]
    report = build_mesh_report(FileMesh(path=write(tmp_path, text)))
    (found,) = [one for one in report.findings if one.name == name]
    assert found.is_suspicious
    assert place in format_finding(found, report.cells)
    assert remedy in found.remedy
    assert report.is_suspicious


@pytest.mark.parametrize("text", [CLEAN, OCTAHEDRON], ids=["square", "octahedron"])
def test_a_clean_mesh_has_no_findings(tmp_path, text):
    assert build_mesh_report(FileMesh(path=write(tmp_path, text))).findings == []


def test_parts_without_a_scene_are_a_remark(tmp_path):
    report = build_mesh_report(FileMesh(path=write(tmp_path, f"{CLEAN}v 3 0 0\nv 4 0 0\nv 3 1 0\nf 5 6 7\n")))
    assert [one.name for one in report.findings] == ["parts"]
    assert not report.is_suspicious
    assert report.facts["part_sizes"] == [4, 3]


@pytest.mark.parametrize(("extent", "scale"), [(1700, 0.001), (160, 0.01), (67, 0.0254), (0.0018, 1000.0)])
def test_a_unit_is_guessed_from_the_extent(extent, scale):
    unit = guess_unit(extent)
    assert unit is not None
    assert unit[1] == scale
    assert guess_unit(1.0) is None


def test_an_extent_that_no_unit_explains_is_a_remark(tmp_path):
    report = build_mesh_report(FileMesh(path=write(tmp_path, CLEAN), units="nm"))
    (found,) = report.findings
    assert (found.name, found.is_suspicious) == ("units", False)
    assert "1e-09 m wide, high or deep, which is unusual for cloth" in found.problem


def run_command(*arguments: object) -> tuple[int, str]:
    """The exit code and output of the command."""
    done = CliRunner().invoke(app, ["mesh", *map(str, arguments)])
    return done.exit_code, done.output


def test_the_command_prints_facts_and_findings_and_is_strict_on_request(tmp_path):
    path = write(tmp_path, FAULTS["coincident-vertices"][0])
    code, output = run_command(path)
    assert code == 0
    for words in ("6 vertices, 2 triangles, 6 edges", "1 x 1 x 0 m", "1 m²", "2: 3, 3 vertices", "! vertices in the"):
        assert words in output
    assert run_command(path, "--strict")[0] == 1
    assert run_command(path, "--strict", "--weld", 0)[0] == 0
    code, output = run_command(path, "--units", "furlong")
    assert code == 2
    assert "--units" in output


def test_the_command_prints_json_with_all_places(tmp_path):
    path = write(tmp_path, FAULTS["coincident-vertices"][0])
    code, output = run_command(path, "--json", "--strict")
    data = json.loads(output)
    assert code == 1
    assert data["area"] == pytest.approx(1.0, rel=1e-12)
    assert data["groups"]["left"] == 3
    (seam,) = [one for one in data["findings"] if one["is_suspicious"]]
    assert (seam["name"], seam["count"], seam["vertices"]) == ("coincident-vertices", 2, [1, 2, 3, 5])


def test_attributes_that_are_no_numbers_are_reported(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(
        f"property float {x}\n" for x in ("x", "y", "z", "a", "b")
    )
    corners = "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    path = tmp_path / "mesh.ply"
    path.write_text(f"{head}{corners}0 0 0 nan 1\n1 0 0 inf 2\n0 1 0 nan nan\n3 0 1 2\n")
    assert json.loads(run_command(path, "--json")[1])["attributes"] == {"a": [], "b": [1, 2]}
    assert "a without finite values, b 1 to 2" in run_command(path)[1]


SCENE = """
mesh: {kind: file, path: mesh.obj}
mass: 1
time_step: 1/30
frames: 2
effects: [{kind: springs, stretch: 100}, {kind: gravity}, {kind: pins, indices: [2]}]
"""


def test_a_scene_lists_parts_without_pins_or_attachments(tmp_path, caplog):
    write(tmp_path, FAULTS["coincident-vertices"][0])
    (tmp_path / "scene.yaml").write_text(SCENE)
    code, output = run_command(tmp_path / "scene.yaml", "--strict")
    assert code == 1
    assert "parts without a support: 1 of 2, with 3 vertices (vertex 4, 5, 6)" in output
    assert not caplog.messages  # the report says it once
    CliRunner().invoke(app, ["list", str(tmp_path / "scene.yaml")])
    assert any("parts without a support: 1 of 2" in message for message in caplog.messages)
    assert any("`weld: 0` joins them" in message for message in caplog.messages)
    (tmp_path / "scene.yaml").write_text(SCENE.replace("mesh.obj", "mesh.obj, weld: 0"))
    assert run_command(tmp_path / "scene.yaml", "--strict")[0] == 0
    caplog.clear()
    CliRunner().invoke(app, ["list", str(tmp_path / "scene.yaml")])
    assert not any("springbench mesh" in message for message in caplog.messages)


REFUSED_FAULTS = {
    "unused-vertices": "`unused: drop`",
    "repeated-corners": "`faces: drop-degenerate`",
    "crossed-faces": "list its corners in order",
}
"""Faults with which a scene does not start, and the remedy that the error names."""
EARLY_FAULTS = {"flat-faces": "triangles without area", "duplicate-faces": "each counts once"}
"""Faults that a scene names in other words."""


@pytest.mark.parametrize("name", FAULTS)
def test_the_start_of_a_run_names_each_fault(tmp_path, caplog, name):
    text, *_ = FAULTS[name]
    report = build_mesh_report(FileMesh(path=write(tmp_path, text)))
    (found,) = [one for one in report.findings if one.name == name]
    (tmp_path / "scene.yaml").write_text(SCENE)
    done = CliRunner().invoke(app, ["list", str(tmp_path / "scene.yaml")])
    if name in REFUSED_FAULTS:
        assert done.exit_code == 2
        assert REFUSED_FAULTS[name] in " ".join(done.output.split())
    else:
        assert done.exit_code == 0
        assert any(EARLY_FAULTS.get(name, found.problem.split(":")[0]) in message for message in caplog.messages)


def test_a_scene_without_a_mesh_file_is_refused(tmp_path):
    (tmp_path / "scene.yaml").write_text(SCENE.replace("{kind: file, path: mesh.obj}", "{kind: star}"))
    code, output = run_command(tmp_path / "scene.yaml")
    assert code == 2
    assert "names no mesh file" in " ".join(output.split())


@pytest.mark.slow
@pytest.mark.skipif(opengl_probe.find_opengl_problem() is not None, reason=opengl_probe.find_opengl_problem() or "")
def test_the_picture_marks_the_places(tmp_path):
    picture = tmp_path / "mesh.png"
    assert run_command(write(tmp_path, FAULTS["t-junctions"][0]), "-o", picture)[0] == 0
    with Image.open(picture) as drawn:
        pixels = np.asarray(drawn.convert("RGB"), np.int64)[150:700, :1000]  # of the mesh, which is grey
    assert int((np.ptp(pixels, axis=2) > 60).sum()) > 200  # five spheres


def test_a_picture_of_another_format_is_refused(tmp_path):
    write(tmp_path, CLEAN)
    assert run_command(tmp_path / "mesh.obj", "-o", tmp_path / "mesh.jpg")[0] == 2
