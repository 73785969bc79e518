"""A notebook shows the picture of a simulation, and its text where nothing can be drawn."""

from __future__ import annotations

import io

import numpy as np
import pytest
import springbench
from PIL import Image
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report import opengl_probe


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


def test_nothing_is_shown_where_nothing_can_be_drawn(
    simulation: springbench.Simulation, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(opengl_probe, "find_opengl_problem", lambda: "no OpenGL")
    assert simulation._repr_png_() is None
