"""A folder of results belongs to one config: two of one name would write over each other's pictures.

The folder holds the way to its config. A config that was moved takes its folder along; one that still is where it was
keeps it.
"""

from __future__ import annotations

import os
from pathlib import Path

from harness.base.errors import InputError, Mistake
from harness.base.files import replacing

NAME = ".config"


def claimed(folder: Path, config: Path) -> Path:
    """The folder of a config's results, made if it is not there. Raises InputError where it is another config's."""
    folder.mkdir(parents=True, exist_ok=True)
    note, way = folder / NAME, os.path.relpath(config.resolve(), folder.resolve())
    said = note.read_text(errors="replace").strip()[:4096] if note.is_file() else way
    owner = folder / said
    if said != way and "\0" not in said and owner.is_file() and not owner.samefile(config):
        raise InputError(
            Mistake(
                f"holds the results of another file of this name, {owner.resolve()}; rename one of the two, or choose "
                "another folder with --results",
                folder,
            )
        )
    if said != way or not note.exists():
        with replacing(note) as partial:
            partial.write_text(way + "\n")
    return folder
