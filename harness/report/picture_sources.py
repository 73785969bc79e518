"""Digest of the data of a picture, stored in the PNG file.

A picture is drawn again only if the digest changes.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa

SOURCES_KEY = "Source"
"""Keyword of the PNG text that contains the digest."""
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHECKSUM_BYTES = 4
"""Number of bytes after the content of a chunk; its length and type are before it."""


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
    """Return the digest stored in a picture, or None.

    It is None if there is no digest, or if the picture is missing or unreadable. Only the chunks before the pixels are
    read, without an imaging library, whose import takes far longer.
    """
    keyword = f"{SOURCES_KEY}\0".encode("latin-1")
    with suppress(OSError, struct.error), path.open("rb") as file:
        if file.read(len(_PNG_SIGNATURE)) != _PNG_SIGNATURE:
            return None
        kind = b""
        while kind != b"IDAT":
            length, kind = struct.unpack(">I4s", file.read(8))
            if kind == b"tEXt" and (text := file.read(length)).startswith(keyword):
                return text.removeprefix(keyword).decode("latin-1")
            file.seek(_CHECKSUM_BYTES + (0 if kind == b"tEXt" else length), os.SEEK_CUR)
    return None
