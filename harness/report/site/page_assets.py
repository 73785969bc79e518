"""Static files of the results page: scripts, style, and Plotly's script.

Plotly's script is that of the installed package.
"""

from __future__ import annotations

import shutil
from functools import cache
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

from springbench.harness.atomic_files import atomic_write

_SITE_FOLDER = Path(__file__).parent
_STATIC_FOLDER = _SITE_FOLDER / "static"


@cache
def compute_page_version() -> str:
    """Return a version: 12 hexadecimal digits of SHA-256 over the files that determine a page."""
    parts = sorted(path for path in _SITE_FOLDER.rglob("*") if path.suffix in (".py", ".js", ".css", ".html"))
    return sha256(b"".join(path.read_bytes() for path in parts)).hexdigest()[:12]


def install_assets(results: Path) -> str:
    """Install the page next to the folders of results, and return its version.

    Files that are up to date are not written again.
    """
    site, stamp = results / "site", results / "site" / "version.txt"
    if stamp.is_file() and stamp.read_text() == compute_page_version() and (results / "index.html").is_file():
        return compute_page_version()
    site.mkdir(exist_ok=True)
    for path in _STATIC_FOLDER.iterdir():
        _copy_file(path, results / path.name if path.name == "index.html" else site / path.name)
    _copy_file(plotly_path(), site / "plotly.js")
    with atomic_write(stamp) as partial:
        partial.write_text(compute_page_version())
    return compute_page_version()


def plotly_path() -> Path:
    """Return the path of Plotly's script, without importing the package."""
    found = find_spec("plotly")
    (home,) = (found.submodule_search_locations if found else None) or (None,)
    return Path(str(home)) / "package_data" / "plotly.min.js"


def _copy_file(path: Path, target: Path) -> None:
    with atomic_write(target) as partial:
        shutil.copyfile(path, partial)
