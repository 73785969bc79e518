"""Files that are whole or not there, and in words why one cannot be written."""

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
    """The disk is full, or will not be written for another such reason: no fault of a run, which may be done again."""


_STEM = 100
"""So much of a file's name stands in its partial name, which may not be too long for the disk."""


def partial_name(path: Path) -> Path:
    """What a file is called while this process writes it."""
    return path.with_name(f".{path.stem[:_STEM]}.{os.getpid()}.partial{path.suffix}")


def half_written(path: Path) -> Iterator[Path]:
    """What any process left half written of a file."""
    return path.parent.glob(f".{escape(path.stem[:_STEM])}.*.partial{path.suffix}")


@contextmanager
def replacing(path: Path) -> Generator[Path]:
    """A partial name beside a file, for what takes the file's place where nothing goes wrong, and goes where it does.

    Raises CannotWrite from an OSError.
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
    """A file to lock, opened, and made where it is missing; access: for reading or writing. No link is followed, and
    nothing is waited for. Raises InputError that says what is in the way; otherwise: what else to do than remove it.
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
    """What a file is that is no plain one, in words."""
    kinds = {stat.S_IFIFO: "a pipe", stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def is_file_name(text: str) -> bool:
    """Whether a text is the name of a file or of a folder, and no path."""
    size = len(text.encode(errors="surrogateescape"))
    return 0 < size <= 240 and "/" not in text and "\0" not in text and text not in (".", "..")


def safe_name(text: str) -> str:
    """The text as the name of a file in a folder, whatever it says: letters, digits and any of `._-` are left."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip("._")[:200] or "_"


def users_cache(name: str) -> Path:
    """Where a kind of file is kept for the user, between commands; the folder may not be there."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench" / name


MISTAKES = {
    *(errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENODEV, errno.ENOENT),
    *(errno.ENOTDIR, errno.ENXIO, errno.EOPNOTSUPP, errno.EPERM, errno.EROFS),
}
"""What the system says to a path that is the user's mistake."""


def told(error: OSError) -> str:
    """The file that an error is about, and why, as a message."""
    names = " and ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
    return f"{names or 'a file'}: {reason(error)}"


def cannot_write(path: Path, error: Exception) -> CannotWrite:
    """What to raise where a file cannot be written because of an error."""
    return CannotWrite(f"{path}: cannot be written: {reason(error)}")


def reason(error: Exception) -> str:
    """What the system says of an error, else what the error does: `No space left on device`."""
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else " ".join(str(error).split()) or type(error).__name__


HEAD = 1024
"""Bytes by which `misnamed` tells what a file is."""


def misnamed(head: bytes, size: int) -> str:
    """Say what a file is that has the name of a data file and holds none, by its first HEAD bytes and its size; "" for
    any other file."""
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if not start and size <= len(head):
        return "is empty"
    if start.startswith(b"version https://git-lfs.github.com/spec/"):
        return "is a Git LFS pointer; run `git lfs pull` to get the file itself"
    if start.startswith((b"<!doctype html", b"<html")):
        return "is a web page; download the file itself"
    return ""
