"""A notebook shows pictures of simulations and runs, Rerun's viewer, tables and progress."""

from __future__ import annotations

import io
from pathlib import Path

import nbformat
import numpy as np
import pytest
import springbench
from nbclient import NotebookClient
from PIL import Image
from springbench.harness.execution.optional_parts import NOTEBOOKS, OptionalPart
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report import opengl_probe
from springbench.harness.report.self_intersection_notes import describe_self_intersection


@pytest.fixture
def simulation() -> springbench.Simulation:
    return springbench.Simulation(springbench.load_scene("cloth-on-sphere"), "sparse", size=4)


@pytest.mark.slow
@pytest.mark.skipif(opengl_probe.find_opengl_problem() is not None, reason="needs OpenGL")
def test_a_simulation_is_shown_as_a_picture(simulation: springbench.Simulation):
    content = simulation._repr_png_()
    assert content
    with Image.open(io.BytesIO(content)) as picture:
        assert np.ptp(np.asarray(picture.convert("L"))[200:]) > 50, "something is drawn below the heading"


def test_a_picture_has_the_start_and_the_present_state(
    simulation: springbench.Simulation, monkeypatch: pytest.MonkeyPatch
):
    drawn = list[RecordingReplay]()
    monkeypatch.setattr("springbench.harness.api.draw_picture", drawn.append)
    simulation.draw_state()
    simulation.run_steps(2)
    simulation.draw_state()
    assert [replay.frames.tolist() for replay in drawn] == [[0], [0, 2]]
    assert drawn[1].absolute_positions(1) == pytest.approx(simulation.positions, abs=1e-6)
    assert "sphere" in str(drawn[1].properties["obstacles"])
    assert describe_self_intersection(drawn[1], [1]) == ["no self-contact"]


def test_nothing_is_shown_where_nothing_can_be_drawn(
    simulation: springbench.Simulation, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(opengl_probe, "find_opengl_problem", lambda: "no OpenGL")
    assert simulation._repr_png_() is None


CELLS = (
    """
import springbench
sweep = {"scenes": ["chain"], "sizes": [5], "solvers": ["sparse"],
         "options": {"frames": 2, "rounds": 1, "pictures": False}}
springbench.run_config(sweep, name="small")
""",
    """
from pathlib import Path
(path,) = Path("results/small/recordings").glob("*.rrd")
springbench.view_recording(path)
""",
    "springbench.open_recording(path)",
)


@pytest.mark.slow
@pytest.mark.skipif(not NOTEBOOKS.is_installed(), reason=NOTEBOOKS.describe_absence())
@pytest.mark.skipif(opengl_probe.find_opengl_problem() is not None, reason="needs OpenGL")
def test_a_notebook_shows_progress_rows_the_viewer_and_the_picture_of_a_run(tmp_path: Path):
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    NotebookClient(
        notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    sweep, viewer, picture = ([dict(output.get("data", {})) for output in cell.outputs] for cell in notebook.cells)
    bars, line, rows = sweep
    assert "100 %" in bars["text/plain"], "the bar is redrawn in place"
    assert "sweep" in bars["text/html"]
    assert "chain 5 sparse" in line["text/plain"]
    assert "<table" in rows["text/html"]
    assert any("rerun_notebook.Viewer" in output["text/plain"] for output in viewer)
    assert all("application/vnd.jupyter.widget-view+json" in output for output in viewer)
    assert picture[0]["text/plain"] == "RunRecording('chain 5 - sparse', 3 frames of 5 vertices)"
    assert len(picture[0]["image/png"]) > 10_000


def test_the_viewer_names_what_it_needs_and_reads_recordings_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(OptionalPart, "is_installed", lambda part: False)
    with pytest.raises(springbench.InputError, match=r'pip install "springbench\[notebook\]"'):
        springbench.view_recording(tmp_path / "a.rrd")
    monkeypatch.setattr(OptionalPart, "is_installed", lambda part: True)
    with pytest.raises(springbench.InputError, match="there is no such file"):
        springbench.view_recording(tmp_path / "a.rrd")
