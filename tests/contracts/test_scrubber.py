"""A solve on the page, in a real browser: each iterate next to the reference, coloured by its distance from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.report.site import update_page

from tests import synthetic_accuracy_rows
from tests.headless_browser import launch_chromium
from tests.synthetic_recordings import build_recording_info, write_recording

AMPLITUDES = {"newton": 0.05, "lbfgs": 0.1}
COLOURED_SHARE = """canvas => {
  const { width, height } = canvas, shown = canvas.getContext("2d").getImageData(0, 0, width, height).data;
  let found = 0;
  for (let k = 0; k < shown.length; k += 4) {
    const channels = shown.slice(k, k + 3);
    found += Math.max(...channels) - Math.min(...channels) > 60;
  }
  return found / (width * height);
}"""
"""The share of a canvas that is in colour, and not grey."""


def study(folder: Path) -> str:
    """A page with two solves of one step and their recordings, whose iterates differ."""
    rows = synthetic_accuracy_rows.build_snapshot_rows("net", 6, "early")
    (folder / "study" / "recordings").mkdir(parents=True)
    for solver, amplitude in AMPLITUDES.items():
        name = f"recordings/net-6-early-{solver}.rrd"
        write_recording(
            folder / "study" / name, replace(build_recording_info(), is_solve=True), frame_count=8, amplitude=amplitude
        )
        rows += [
            row | {"recording_path": name}
            for row in synthetic_accuracy_rows.build_curve_rows("net", 6, "early", solver)
        ]
    synthetic_accuracy_rows.write_accuracy_rows(folder / "study", rows)
    return update_page(folder, with_recordings=True).as_uri()


@pytest.mark.slow
def test_each_iterate_is_shown_with_its_distance_to_the_reference(tmp_path: Path):
    page = study(tmp_path)
    files = {solver: read_replay(tmp_path / f"study/recordings/net-6-early-{solver}.rrd") for solver in AMPLITUDES}
    with launch_chromium() as browser:
        tab = browser.new_page(viewport={"width": 1280, "height": 1200})
        said: list[str] = []
        tab.on("console", lambda message: said.append(message.text))
        tab.on("pageerror", lambda error: said.append(str(error)))
        tab.goto(f"{page}#plots?sweep=study&plot=convergence")
        plot = tab.get_by_role("group")
        plot.focus()
        for key in ("ArrowRight", "Enter"):
            tab.keyboard.press(key)
        point = tab.get_by_role("region", name="The chosen point")
        slider = point.get_by_label("Iteration")
        slider.wait_for()
        expected, of = point.get_by_role("status"), slider.get_attribute("aria-valuetext")
        assert of
        solver = expected.inner_text().partition(",")[0]
        (reference,) = (s for s in AMPLITUDES if point.get_by_text(f"the last iterate of {s}").count())
        left, right = (point.locator("canvas").nth(k) for k in (0, 1))
        for key, frame in (("Home", 0), ("End", -1)):
            slider.press(key)
            shown, best = files[solver].positions[frame], files[reference].positions[-1]
            far = float(np.linalg.norm(shown - best, axis=1).max())
            words = expected.inner_text()
            assert f"iteration {files[solver].frames[frame]}:" in words
            assert float(words.split(" is ")[1].split(" m ")[0].replace("−", "-")) == pytest.approx(far, rel=0.01)
        slider.press("Home")
        assert left.evaluate(COLOURED_SHARE) > 0.1
        assert right.evaluate(COLOURED_SHARE) == 0.0, "the reference has no distance from itself"
        slider.press("ArrowRight")
        left.press("ArrowRight")
        tab.wait_for_function("/at=.*turn=/.test(location.hash)")
        link, told_then = tab.evaluate("location.href"), expected.inner_text()
        seen = left.evaluate("canvas => canvas.toDataURL()")
        tab.goto("about:blank")
        tab.goto(link)
        slider.wait_for()
        tab.wait_for_function("document.documentElement.dataset.ready === location.hash")
        assert expected.inner_text() == told_then, "a link shows the iterate"
        assert left.evaluate("canvas => canvas.toDataURL()") == seen, "turned as it was"
        tab.screenshot(path=tmp_path / "scrubber.png")
        assert not said
