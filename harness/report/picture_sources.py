"""Digest of the data of a picture, stored in the PNG file.

A picture is drawn again only if the digest changes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from pathlib import Path

import pyarrow as pa

SOURCES_KEY = "Source"
"""Keyword of the PNG text that contains the digest."""


def digest_runs(title: str, table: pa.Table, stale_ids: Collection[str]) -> str:
    """Return a digest of the runs in a table.

    Args:
        title: title of the picture.
        table: rows of the runs; a run that is repeated has another `started_at`.
        stale_ids: ids of runs that were executed by other code than the current version.
    """
    ids, starts = (list(map(str, table[name].to_pylist())) for name in ("run_id", "started_at"))
    stale = sorted({*ids}.intersection(stale_ids))
    return hashlib.sha256(json.dumps([title, sorted({*zip(ids, starts, strict=True)}), stale]).encode()).hexdigest()


def read_sources(path: Path) -> str | None:
    """Return the digest stored in a picture; None if the picture is missing or unreadable."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            return str(picture.info.get(SOURCES_KEY, ""))
    except OSError:
        return None
