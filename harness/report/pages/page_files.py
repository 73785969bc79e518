"""Files of pages: write them, or find those that are stale.

`pictures.json` in the published set states for each picture the digest of what it shows and that of its file. A check
therefore draws nothing: a picture is stale if either differs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import imread
from springbench.harness.atomic_files import atomic_write
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.report.pages.page_templates import (
    PICTURE_FOLDER,
    PagePicture,
    RenderedPage,
    find_templates,
    index_pictures,
    render_page,
)
from springbench.harness.report.pages.published_queries import PublishedQueries
from springbench.harness.results.published_set import PUBLISHED_FOLDER

_DIGEST_FILE = PUBLISHED_FOLDER / "pictures.json"

MAX_PIXEL_DIFFERENCE = 0.02
"""Largest mean difference of two pictures, in units of the full range: fonts are rasterised differently elsewhere."""


def render_pages(root: Path) -> list[RenderedPage]:
    """Render all templates of a checkout.

    Raises:
        InputError: if there are no templates or no published set, or if a template has a mistake.
    """
    templates = find_templates(root)
    if not templates:
        raise InputError(InputMistake("contains no templates of pages; expected the root of a checkout", root))
    queries = PublishedQueries(root / PUBLISHED_FOLDER)
    return [render_page(template, queries) for template in templates]


def write_pages(root: Path) -> list[Path]:
    """Write the pages and pictures that changed, and return the files that were written.

    Pictures that no page shows are deleted.
    """
    pages = render_pages(root)
    pictures, digests = index_pictures(pages, root), _read_digests(root)
    written: list[Path] = []
    for page in pages:
        if not page.path.is_file() or page.path.read_text(encoding="utf-8") != page.text:
            _write_file(page.path, page.text.encode())
            written.append(page.path)
    for name, picture in pictures.items():
        if _describe_stale_picture(picture, digests.get(name)):
            content = picture.draw_png()
            _write_file(picture.path, content)
            digests[name] = {"shows": picture.digest, "file": sha256(content).hexdigest()}
            written.append(picture.path)
    for path in _find_orphans(pages):
        path.unlink()
    whole = json.dumps({name: digests[name] for name in sorted(pictures)}, indent=2) + "\n"
    _write_file(root / _DIGEST_FILE, whole.encode())
    return written


def check_pages(root: Path, *, draws_pictures: bool = False) -> list[str]:
    """Return a line for each stale page or picture.

    Args:
        root: root of the checkout.
        draws_pictures: whether to draw all pictures and compare their pixels.
    """
    pages = render_pages(root)
    pictures, digests = index_pictures(pages, root), _read_digests(root)
    lines = [
        f"{page.path} differs from its template and the published set"
        for page in pages
        if not page.path.is_file() or page.path.read_text(encoding="utf-8") != page.text
    ]
    for name, picture in pictures.items():
        why = _describe_stale_picture(picture, digests.get(name))
        if not why and draws_pictures and not _looks_equal(picture):
            why = "is drawn differently by the present code"
        lines += [f"{picture.path} {why}"] if why else []
    return lines + [f"{path} is a picture of no page" for path in _find_orphans(pages)]


def _read_digests(root: Path) -> dict[str, Mapping[str, Any]]:
    path = root / _DIGEST_FILE
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _describe_stale_picture(picture: PagePicture, stated: Mapping[str, Any] | None) -> str:
    """Describe why a picture is stale; empty if it is current."""
    if not picture.path.is_file() or stated is None:
        return "is missing"
    if stated["shows"] != picture.digest:
        return "shows other data than the published set has"
    if stated["file"] != sha256(picture.path.read_bytes()).hexdigest():
        return "is not the file that `springbench pages` wrote"
    return ""


def _looks_equal(picture: PagePicture) -> bool:
    with picture.path.open("rb") as file:
        there = imread(file, format="png")
    here = imread(BytesIO(picture.draw_png()), format="png")
    return there.shape == here.shape and float(np.abs(there - here).mean()) <= MAX_PIXEL_DIFFERENCE


def _find_orphans(pages: list[RenderedPage]) -> list[Path]:
    """Find picture files that no page shows, in the picture folder next to each page."""
    shown = {picture.path for page in pages for picture in page.pictures}
    folders = {page.path.parent / PICTURE_FOLDER for page in pages}
    return sorted(path for folder in folders for path in folder.glob("*.png") if path not in shown)


def _write_file(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as partial:
        partial.write_bytes(content)
