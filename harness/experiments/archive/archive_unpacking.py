"""Unpack an archive of published results, within limits of its size."""

from __future__ import annotations

import shutil
import struct
import zipfile
import zlib
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from springbench.harness.atomic_files import explain_unreadable_file
from springbench.harness.errors import InputError, InputMistake

_MAX_FILES, _MAX_COMPRESSION_RATIO = 200_000, 200
"""Largest number of files in an archive, and ratio of unpacked to packed size."""


@contextmanager
def unpack_archive(archive: Path) -> Generator[Path]:
    """Unpack an archive to a temporary folder. Raises InputError for a damaged or oversized archive."""
    expected = "expected an archive that `springbench publish` wrote (.zip)"
    if not archive.is_file():  # a device or a pipe would be read for ever
        raise InputError(
            InputMistake(f"{'is no plain file' if archive.exists() else 'does not exist'}; {expected}", archive)
        )
    with TemporaryDirectory() as scratch:
        try:
            with zipfile.ZipFile(archive) as packed:
                if why := _explain_excess(packed.infolist(), archive.stat().st_size, shutil.disk_usage(scratch).free):
                    raise InputError(InputMistake(f"{why}; {expected}", archive))
                packed.extractall(scratch)  # names that lead out of the folder are made to stay in it
        except (*_DAMAGED_ARCHIVE_ERRORS, OSError) as error:
            problem = explain_unreadable_file(archive) or f"cannot be unpacked ({error}); {expected}"
            raise InputError(InputMistake(problem, archive)) from error
        yield Path(scratch)


_DAMAGED_ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    RuntimeError,
    NotImplementedError,
    ValueError,
    EOFError,
    zlib.error,
    struct.error,
)
"""Errors that zipfile raises for damaged or forged archives."""


def _explain_excess(files: Sequence[zipfile.ZipInfo], size: int, free: int) -> str:
    """Return why an archive is not unpacked; empty if it is.

    Args:
        files: entries of the archive.
        size: size of the archive [B].
        free: free space on the disk [B].
    """
    unpacked = sum(info.file_size for info in files)
    if len(files) > _MAX_FILES:
        return f"contains {len(files):,} files, and at most {_MAX_FILES:,} are unpacked"
    if unpacked > free:
        return f"takes {unpacked:,} bytes unpacked; there are {free:,}"
    if unpacked > _MAX_COMPRESSION_RATIO * size or sum(info.compress_size for info in files) > size:
        return f"takes {unpacked:,} bytes unpacked of {size:,}, which no results do"
    if any(info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for info in files):
        return "is compressed by another method"
    return ""
