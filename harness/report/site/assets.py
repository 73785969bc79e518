"""Static files of the results page: scripts, style, and Plotly's script.

Plotly's script comes from the installed package.
"""

from __future__ import annotations

import shutil
from functools import cache
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

from harness.base.files import replacing

_HERE = Path(__file__).parent
_STATIC = _HERE / "static"


@cache
def version() -> str:
    """Return a version: 12 hexadecimal digits of SHA-256 over the files that determine a page."""
    parts = sorted(path for path in _HERE.rglob("*") if path.suffix in (".py", ".js", ".css", ".html"))
    return sha256(b"".join(path.read_bytes() for path in parts)).hexdigest()[:12]


def place(results: Path) -> str:
    """Install the page next to the folders of results, and return its version.

    Files that are up to date are not written again.
    """
    site, stamp = results / "site", results / "site" / "version.txt"
    if stamp.is_file() and stamp.read_text() == version() and (results / "index.html").is_file():
        return version()
    site.mkdir(exist_ok=True)
    for path in _STATIC.iterdir():
        _copy(path, results / path.name if path.name == "index.html" else site / path.name)
    _copy(plotly(), site / "plotly.js")
    with replacing(stamp) as partial:
        partial.write_text(version())
    return version()


def plotly() -> Path:
    """Return the path of Plotly's script, without importing the package."""
    found = find_spec("plotly")
    (home,) = (found.submodule_search_locations if found else None) or (None,)
    return Path(str(home)) / "package_data" / "plotly.min.js"


def _copy(path: Path, target: Path) -> None:
    with replacing(target) as partial:
        shutil.copyfile(path, partial)
