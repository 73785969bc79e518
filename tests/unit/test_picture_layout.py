"""Where the frames of a run's picture go, what its scale shows, and what distances are taken from."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.errors import RunFailed
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.recording.strain_shading import compute_strain_range
from springbench.harness.report import opengl_probe
from springbench.harness.report.comparison_picture import draw_comparison_picture, find_reference_run
from springbench.harness.report.drawable_frames import strain_scale_limit
from springbench.harness.report.plot_style import PAGE_HEIGHT, PAGE_WIDTH
from springbench.harness.report.run_picture import draw_run_picture, layout_frames
from springbench.harness.report.site.mesh_scripts import _select_iterates

from tests.unit.test_report_pictures import break_frame, cloth, falling


@pytest.mark.parametrize("shape", [0.2, 1.0, 1.3, 4.0])
def test_frames_of_any_shape_fill_the_page_and_do_not_meet(shape: float) -> None:
    main, tiles = layout_frames(shape, shape, 5)
    boxes = [main, *tiles]
    assert all(
        box.left >= 0 and box.left + box.width <= PAGE_WIDTH and box.top + box.height <= PAGE_HEIGHT for box in boxes
    )
    for a, b in combinations(boxes, 2):
        assert a.left + a.width <= b.left or b.left + b.width <= a.left or a.top + a.height <= b.top
    # What is seen of a scene: the largest rectangle of its shape that fits into its place. Of the page's height and
    # the width of one column next to it, squares had a fourth, and what lies flat less.
    seen = sum(min(box.width, box.height * shape) * min(box.height, box.width / shape) for box in boxes)
    assert seen > 0.38 * 1528 * 750


def test_the_scale_is_that_of_the_strains_that_are_seen() -> None:
    # All springs at 5 % but those of a corner at 40 %: a scale to 40 % would show one grey cloth.
    one = cloth(24, frames=1)
    stretched = one.positions.copy()
    stretched[0, 0] += np.array([-0.4 / 23, 0.0, 0.0], np.float32)
    assert strain_scale_limit([replace(one, positions=stretched)], [0]) == pytest.approx(0.05)
    assert strain_scale_limit([one], [0]) == pytest.approx(0.05)
    assert strain_scale_limit([cloth(stretch=1.39, frames=1)], [0]) == pytest.approx(0.4)


@pytest.mark.parametrize("n", [6, 12])
def test_a_runaway_vertex_does_not_set_the_scale(n: int) -> None:
    """Its springs, at 22,000 % and more, end at 3 to 9 % of the vertices, and would leave all others grey."""
    away = falling(cloth(n), slice(3, 4), 44.0)
    assert strain_scale_limit([cloth(n), away], [7, 7]) == strain_scale_limit([cloth(n)], [7]) == pytest.approx(0.05)
    rest, p = (away.positions[k].astype(np.float64) for k in (0, 7))
    for positions in (p, np.where(np.arange(n * n)[:, None] == 3, np.nan, p)):
        assert compute_strain_range(rest, [positions], away.springs, away.rest_lengths) == pytest.approx(0.05)


def test_iterates_that_diverge_do_not_set_the_scale_of_distances() -> None:
    """The vertices of a solve's iterates end 1 mm to 1 m from the reference; one of 36 leaves in one iterate of 8."""
    replay = cloth()
    reference = replay.positions[-1] + np.array([0.0, 0.0, 1e-3], np.float32)
    replay.positions[:, :, 2] += np.geomspace(1.0, 1e-3, 8, dtype=np.float32)[:, None] - np.float32(1e-3)
    usual = _select_iterates(replay, reference)["max_distance"]
    assert usual == pytest.approx(1.04, abs=0.05)
    for value in (1e30, np.nan, np.inf):
        replay.positions[3, 5] = value
        assert _select_iterates(replay, reference)["max_distance"] == pytest.approx(usual, rel=0.02)
    replay.positions[:] = np.nan
    assert _select_iterates(replay, reference)["max_distance"] == 1.0


def test_distances_are_taken_from_the_lowest_residual_that_ends_finite() -> None:
    def ending(residual: float) -> RecordingReplay:
        return replace(cloth(), scalars={"/residual": (np.array([1]), np.array([residual]))})

    assert find_reference_run([ending(1e-2), ending(1e-9), ending(1e-6)]) == 1
    assert find_reference_run([ending(1e-2), break_frame(ending(1e-9), 3)]) == 0
    assert find_reference_run([replace(cloth(), scalars={}), ending(1e-2)]) == 1
    assert find_reference_run([ending(np.nan), ending(1e-2)]) == 1


def test_without_opengl_the_message_names_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(
        opengl_probe, "_PROBE_SCRIPT", "import os; os.kill(os.getpid(), 11)"
    )  # as VTK ends without the libraries
    opengl_probe.find_opengl_problem.cache_clear()
    try:
        for draw in (lambda at: draw_run_picture(cloth(), at), lambda at: draw_comparison_picture({"a": cloth()}, at)):
            with pytest.raises(RunFailed, match="apt-get install libegl1 libgl1-mesa-dri"):
                draw(tmp_path / "run.png")
    finally:
        opengl_probe.find_opengl_problem.cache_clear()
    assert not list(tmp_path.iterdir())


def test_a_trial_drawing_that_succeeded_is_not_repeated_until_the_libraries_change(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def count_trials() -> int:
        opengl_probe.find_opengl_problem.cache_clear()
        trials.clear()
        assert opengl_probe.find_opengl_problem() is None
        return len(trials)

    trials: list[object] = []
    begin = opengl_probe.subprocess.Popen
    monkeypatch.setattr(opengl_probe.subprocess, "Popen", lambda *a, **k: trials.append(a) or begin(*a, **k))
    monkeypatch.setattr(opengl_probe, "_PROBE_SCRIPT", "pass")
    monkeypatch.setattr(opengl_probe, "_SYSTEM_FILES", (str(tmp_path / "packages"),))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("DISPLAY", raising=False)
    try:
        assert [count_trials(), count_trials()] == [1, 0]
        (tmp_path / "packages").write_text("one less")
        assert [count_trials(), count_trials()] == [1, 0]
    finally:
        opengl_probe.find_opengl_problem.cache_clear()
