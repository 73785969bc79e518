"""The digest in a picture, read without an imaging library."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from springbench.harness.report.picture_sources import SOURCES_KEY, read_sources


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    """A picture with a title and a digest."""
    texts = PngInfo()
    texts.add_text("Title", f"{SOURCES_KEY} of all")
    texts.add_text(SOURCES_KEY, "0123abcd")
    Image.new("RGB", (3, 2)).save(path := tmp_path / "picture.png", pnginfo=texts)
    return path


def test_the_digest_is_the_text_that_an_imaging_library_finds(picture: Path):
    with Image.open(picture) as opened:
        assert read_sources(picture) == opened.info[SOURCES_KEY] == "0123abcd"


def test_a_picture_without_a_digest_has_none(tmp_path: Path):
    Image.new("RGB", (3, 2)).save(path := tmp_path / "plain.png")
    assert read_sources(path) is None


@pytest.mark.parametrize("length", [0, 7, 20, 40])
def test_a_part_of_a_picture_has_no_digest(picture: Path, length: int):
    picture.write_bytes(picture.read_bytes()[:length])
    assert read_sources(picture) is None


def test_a_missing_picture_and_a_folder_have_no_digest(tmp_path: Path):
    assert read_sources(tmp_path / "missing.png") is None
    assert read_sources(tmp_path) is None
