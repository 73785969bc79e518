"""Atomic file writes, lock files, safe file names, and messages for file errors."""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Generator, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path

from harness.base.errors import InputError, Mistake, SpringbenchError


class CannotWrite(SpringbenchError):
    """A file cannot be written, for example because the disk is full.

    The run itself is valid and may be repeated.
    """


_STEM = 100
"""Maximum length of the stem in a temporary name, which the file system limits."""


def partial_name(path: Path) -> Path:
    """Return the temporary name of a file while this process writes it."""
    return path.with_name(f".{path.stem[:_STEM]}.{os.getpid()}.partial{path.suffix}")


def half_written(path: Path) -> Iterator[Path]:
    """Find incomplete temporary files of a path, left by any process."""
    return path.parent.glob(f".{escape(path.stem[:_STEM])}.*.partial{path.suffix}")


@contextmanager
def replacing(path: Path) -> Generator[Path]:
    """Yield a temporary path that replaces the file on success and is removed on failure.

    Raises:
        CannotWrite: for an OSError inside the block.
    """
    partial = partial_name(path)
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise cannot_write(path, error) from error
    finally:
        with suppress(OSError):  # a folder that is gone tells its own tale
            partial.unlink(missing_ok=True)


def open_lock(path: Path, access: int = os.O_RDWR, *, otherwise: str = "") -> int:
    """Open a lock file and create it if it is missing.

    Symbolic links are not followed, and the call does not block.

    Args:
        path: lock file.
        access: flag of `os.open`, for reading or writing.
        otherwise: alternative to removing the file, appended to the error message.
    Returns: file descriptor.
    Raises:
        InputError: if something else is at this path.
    """
    flags = access | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        try:
            lock = os.open(path, flags)
        except FileNotFoundError:
            with suppress(FileExistsError):  # by another process, a moment ago
                os.close(os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o644))
            lock = os.open(path, flags)
    except OSError as error:
        if not os.path.lexists(path) or error.errno not in _IN_THE_WAY:
            raise
        mode = os.lstat(path).st_mode
        what = f"cannot be opened ({reason(error)})" if stat.S_ISREG(mode) else f"is {_kind(mode)}"
        raise InputError(Mistake(f"{what}; wanted a plain file to lock: remove it{otherwise}", path)) from error
    mode = os.fstat(lock).st_mode
    if not stat.S_ISREG(mode):
        os.close(lock)
        raise InputError(Mistake(f"is {_kind(mode)}; wanted a plain file to lock: remove it{otherwise}", path))
    return lock


_IN_THE_WAY = {errno.EACCES, errno.EPERM, errno.EISDIR, errno.ELOOP, errno.ENXIO, errno.ENODEV, errno.EOPNOTSUPP}


def _kind(mode: int) -> str:
    """Describe the type of a file that is not a regular file."""
    kinds = {stat.S_IFIFO: "a pipe", stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def is_file_name(text: str) -> bool:
    """Return whether a text is a valid file name, and not a path."""
    size = len(text.encode(errors="surrogateescape"))
    return 0 < size <= 240 and "/" not in text and "\0" not in text and text not in (".", "..")


def safe_name(text: str) -> str:
    """Convert a text to a safe file name of letters, digits, `.`, `_` and `-`."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip("._")[:200] or "_"


def users_cache(name: str) -> Path:
    """Return the user's cache folder for one kind of file; it may not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench" / name


MISTAKES = {
    *(errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENODEV, errno.ENOENT),
    *(errno.ENOTDIR, errno.ENXIO, errno.EOPNOTSUPP, errno.EPERM, errno.EROFS),
}
"""Error numbers that indicate a mistake of the user in a path."""


def told(error: OSError) -> str:
    """Describe a system error as a message with its file and cause."""
    names = " and ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
    return f"{names or 'a file'}: {reason(error)}"


def cannot_write(path: Path, error: Exception) -> CannotWrite:
    """Build the error for a file that cannot be written."""
    return CannotWrite(f"{path}: cannot be written: {reason(error)}")


def reason(error: Exception) -> str:
    """Describe the cause of an error.

    The system's words are used if possible, such as `No space left on device`, else the error's own.
    """
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else " ".join(str(error).split()) or type(error).__name__


HEAD = 1024
"""Number of leading bytes that `misnamed` examines."""


def misnamed(head: bytes, size: int) -> str:
    """Describe a file that has the name of a data file but other content.

    Args:
        head: first HEAD bytes of the file.
        size: size of the file [bytes].
    Returns: the end of a sentence for an empty file, a Git LFS pointer or a web page; "" for any other file.
    """
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if not start and size <= len(head):
        return "is empty"
    if start.startswith(b"version https://git-lfs.github.com/spec/"):
        return "is a Git LFS pointer; run `git lfs pull` to get the file itself"
    if start.startswith((b"<!doctype html", b"<html")):
        return "is a web page; download the file itself"
    return ""
