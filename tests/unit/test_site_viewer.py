"""Recordings replayed in a page: the viewer's version, the content of its scripts, and both in a real browser."""

from __future__ import annotations

import gzip
import io
import json
import os
import shutil
from base64 import b64decode
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.recording.recording_reader import read_replay
from springbench.harness.report.site import rerun_viewer

from tests.headless_browser import launch_chromium
from tests.synthetic_recordings import write_recording

REPLAY = Path(rerun_viewer.__file__).parent / "static" / "replay.js"
PAGE = (
    '<!doctype html><html lang="en" data-theme=""><title>t</title>'
    '<body><script src="site/replay.js"></script></body></html>'
)


def test_the_viewer_is_the_one_that_the_page_was_written_for():
    words = "open recordings in it (pytest -m long tests/unit/test_site_viewer.py), then raise VERSION"
    assert version("rerun-sdk") == rerun_viewer.RERUN_VERSION, words


def test_a_script_contains_its_recording_and_is_written_once(tmp_path: Path):
    recording = write_recording(tmp_path / "a.rrd", frame_count=3)
    script = rerun_viewer.write_recording(recording, tmp_path / "site" / "a.js", 'cloth "6"')
    name, value = script.read_text().removesuffix(";\n").split(" = ", 1)
    chunk = json.loads(value)
    assert (name, chunk["title"]) == ("springbench.scriptContent", 'cloth "6"')
    assert gzip.decompress(b64decode(chunk["rrd"])) == rerun_viewer.move_layout_first(recording.read_bytes())
    made = script.stat().st_mtime_ns
    rerun_viewer.write_recording(recording, script, "other")
    assert script.stat().st_mtime_ns == made
    os.utime(recording, ns=(made + 1, made + 1))
    rerun_viewer.write_recording(recording, script, "newer")
    assert '"newer"' in script.read_text()


def messages(data: bytes) -> list[bytes]:
    found, place = [], 12
    while place < len(data):
        length = int.from_bytes(data[place + 8 : place + 16], "little")
        found.append(data[place : place + 16 + length])
        place += 16 + length
        if not found[-1][0]:
            break
    return found


def test_a_script_has_the_layout_first_all_that_was_recorded_and_no_index(tmp_path: Path):
    whole = write_recording(tmp_path / "a.rrd", frame_count=12).read_bytes()
    *parts, index = messages(whole)
    turned = messages(rerun_viewer.move_layout_first(whole))
    assert sorted(turned) == sorted(parts)
    assert index[0] == 0
    complete = next(k for k, message in enumerate(turned) if message[0] == 3)
    assert all(b"scene/mesh" not in message[:600] for message in turned[:complete])
    (tmp_path / "b.rrd").write_bytes(rerun_viewer.move_layout_first(whole))
    a, b = (read_replay(tmp_path / name) for name in ("a.rrd", "b.rrd"))
    np.testing.assert_array_equal(a.positions, b.positions)


def site(folder: Path) -> Path:
    """A page that can replay, without the viewer."""
    (folder / "site").mkdir()
    shutil.copy(REPLAY, folder / "site")
    rerun_viewer.write_recording(write_recording(folder / "a.rrd"), folder / "site" / "a.js", "cloth 6")
    (folder / "index.html").write_text(PAGE)
    return folder / "index.html"


def colours(picture: bytes) -> int:
    """How many different colours are in a PNG."""
    from PIL import Image

    return len(np.unique(np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).reshape(-1, 3), axis=0))


def test_the_viewer_gets_a_theme_that_it_supports_and_is_hidden_until_a_recording_is_open():
    """A page that follows the system has an empty theme, of which the viewer complains; see the long test below too."""
    text = REPLAY.read_text()
    assert 'theme: document.documentElement.dataset.theme || (dark ? "dark" : "light")' in text
    assert (
        text.index('canvas.style.visibility = "hidden"')
        < text.index("recording_open")
        < text.index("await handle.start")
    )


@pytest.mark.long
def test_a_page_replays_recordings_from_the_file_system_and_states_what_it_lacks(tmp_path: Path):
    page = site(tmp_path)
    ask = "([script, file]) => springbench.replay('id', script, {file})"
    with launch_chromium() as browser:
        tab, said, arguments = browser.new_page(viewport={"width": 1280, "height": 800}), [], []
        tab.on("console", lambda message: said.append(message.text))
        tab.on("request", lambda request: arguments.append(request.url))
        tab.goto(page.as_uri())
        assert arguments == [page.as_uri(), (page.parent / "site" / "replay.js").as_uri()], (
            "nothing heavy before a click"
        )
        assert not tab.evaluate(ask, ["site/a.js", "a.rrd"])
        for words in ("The viewer is not part of this report", f"springbench view {tmp_path / 'a.rrd'}"):
            assert tab.get_by_role("dialog").get_by_text(words).is_visible()
        assert tab.get_by_role("link", name="The recording as a file").get_attribute("href") == "a.rrd"
        tab.keyboard.press("Escape")
        said.clear()  # the browser's own word of the file that is missing

        rerun_viewer.write_viewer(tmp_path / "site")
        assert not tab.evaluate(ask, ["site/none.js", "a.rrd"])
        assert tab.get_by_text("This recording is not part of the report").is_visible()
        said.clear()
        for _ in range(2):  # the second time without the first one's viewer in the way
            assert tab.evaluate(ask, ["site/a.js", "a.rrd"])
            assert tab.evaluate("document.querySelector('.replay canvas').style.visibility") == ""
            assert tab.get_by_role("heading", name="cloth 6").is_visible()
            tab.wait_for_timeout(500)
            seen = 0
            for _ in range(60):  # software draws slowly
                if (seen := colours(tab.screenshot())) > 400:
                    break
                tab.wait_for_timeout(500)
            assert seen > 400, "a lit mesh has many shades; an empty view has few"
            tab.get_by_role("button", name="Close").click()
            assert not tab.get_by_role("dialog").is_visible()
        assert not said
        assert all(url.startswith("file:") for url in arguments)
