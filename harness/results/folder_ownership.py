"""Ownership of results folders: each belongs to one config.

Two configs of one name therefore cannot overwrite each other's results. The folder stores the relative path of its
config. A config that was moved together with its results remains the owner, and so does one that is still at its old
path.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from springbench.harness.atomic_files import atomic_write
from springbench.harness.errors import InputError, InputMistake

OWNER_FILE = ".config"


_MAX_PATH_BYTES = 4096
"""Number of bytes of the owner file that are read; paths on Linux are at most as long."""


def read_owner(folder: Path) -> Path | None:
    """Return the config that owns a folder, or None if it cannot be found.

    All symbolic links of the path are resolved.
    """
    note = folder / OWNER_FILE
    with suppress(OSError, ValueError):  # the file of a copied folder may contain no path
        if note.is_file():
            with note.open("rb") as file:
                owner = os.fsdecode(file.read(_MAX_PATH_BYTES).strip())
            if owner and (folder / owner).is_file():
                return (folder / owner).resolve()
    return None


def find_config(folder: Path) -> str:
    """Find the config of a sweep's folder, as a path for a command line.

    It is relative to the current folder, or else to the one that contains `configs/`; "" if the config is unknown or
    deleted.
    """
    owner = read_owner(folder)
    if owner is None:
        return ""
    for above in (Path.cwd(), *owner.parents):
        if owner.is_relative_to(above) and (above == Path.cwd() or (above / "configs").is_dir()):
            return owner.relative_to(above).as_posix()
    return owner.name


def claim_folder(folder: Path, config: Path) -> Path:
    """Create the results folder of a config if needed, and record its owner.

    Args:
        folder: results folder.
        config: file of the config, which must exist.

    Returns:
        The folder.

    Raises:
        InputError: if the folder belongs to another config.
    """
    folder.mkdir(parents=True, exist_ok=True)
    owner = read_owner(folder)
    if owner and not owner.samefile(config):
        raise InputError(
            InputMistake(
                f"contains the results of another file of this name, {owner}; rename one of the two, or choose another "
                "folder with --results",
                folder,
            )
        )
    if owner != config.resolve():
        relative_path = os.path.relpath(config.resolve(), folder.resolve())
        with atomic_write(folder / OWNER_FILE) as partial:
            partial.write_bytes(os.fsencode(relative_path) + b"\n")
    return folder
