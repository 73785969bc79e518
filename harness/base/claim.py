"""A folder of results belongs to one config: two of one name would write over each other's pictures.

The folder holds the way to its config. A config that was moved takes its folder along; one that still is where it was
keeps it.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from harness.base.errors import InputError, Mistake
from harness.base.files import replacing

NAME = ".config"


_LONGEST = 4096
"""Bytes of a way to a config; no path is longer."""


def config_of(folder: Path) -> Path | None:
    """The config whose results a folder holds, all links resolved, where it can be found."""
    note = folder / NAME
    with suppress(OSError, ValueError):  # what a folder from elsewhere says may be no path at all
        if note.is_file():
            with note.open("rb") as file:
                said = os.fsdecode(file.read(_LONGEST).strip())
            if said and (folder / said).is_file():
                return (folder / said).resolve()
    return None


def claimed(folder: Path, config: Path) -> Path:
    """The folder of a config's results, made if it is not there. Raises InputError where it is another config's."""
    folder.mkdir(parents=True, exist_ok=True)
    owner = config_of(folder)
    if owner and not owner.samefile(config):
        raise InputError(
            Mistake(
                f"holds the results of another file of this name, {owner}; rename one of the two, or choose another "
                "folder with --results",
                folder,
            )
        )
    if owner != config.resolve():
        way = os.path.relpath(config.resolve(), folder.resolve())
        with replacing(folder / NAME) as partial:
            partial.write_bytes(os.fsencode(way) + b"\n")
    return folder
