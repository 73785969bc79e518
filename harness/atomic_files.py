"""Atomic file writes, outdated files, lock files, safe file names, and messages for file errors."""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from glob import escape
from pathlib import Path

from springbench.harness.errors import InputError, InputMistake, SpringbenchError


class WriteError(SpringbenchError):
    """A file cannot be written, for example because the disk is full.

    The run itself is valid and may be repeated.
    """


_MAX_STEM_LENGTH = 100
"""Maximum length of the stem in a temporary name, which the file system limits."""


def build_partial_path(path: Path) -> Path:
    """Return the temporary name of a file while this process writes it."""
    return path.with_name(f".{path.stem[:_MAX_STEM_LENGTH]}.{os.getpid()}.partial{path.suffix}")


def find_partial_files(path: Path) -> Iterator[Path]:
    """Find incomplete temporary files of a path, left by any process."""
    return path.parent.glob(f".{escape(path.stem[:_MAX_STEM_LENGTH])}.*.partial{path.suffix}")


@contextmanager
def atomic_write(path: Path) -> Generator[Path]:
    """Yield a temporary path that replaces the file on success and is removed on failure.

    Raises:
        WriteError: for an OSError inside the block.
    """
    partial = build_partial_path(path)
    try:
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise build_write_error(path, error) from error
    finally:
        with suppress(OSError):  # the caller reports a missing folder
            partial.unlink(missing_ok=True)


def is_outdated(target: Path, sources: Iterable[Path]) -> bool:
    """Return whether a file is missing, or older than one of its sources.

    Args:
        target: the file.
        sources: files that it is made from, which must exist.
    """
    return not target.is_file() or any(target.stat().st_mtime_ns < source.stat().st_mtime_ns for source in sources)


def open_lock_file(path: Path, access: int = os.O_RDWR, *, hint: str = "") -> int:
    """Open a lock file and create it if it is missing.

    Symbolic links are not followed, and the call does not block.

    Args:
        path: lock file.
        access: flag of `os.open`, for reading or writing.
        hint: alternative to removing the file, appended to the error message.

    Returns:
        File descriptor.

    Raises:
        InputError: if something else is at this path.
        OSError: for any other failure, such as a missing folder.
    """
    flags = access | sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"))
    try:
        try:
            lock = os.open(path, flags)
        except FileNotFoundError:
            with suppress(FileExistsError):  # by another process, a moment ago
                os.close(os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o644))
            lock = os.open(path, flags)
    except OSError as error:
        if not os.path.lexists(path) or error.errno not in _BLOCKING_ERRNOS:
            raise
        mode = os.lstat(path).st_mode
        what = (
            f"cannot be opened ({describe_cause(error)})" if stat.S_ISREG(mode) else f"is {_describe_file_type(mode)}"
        )
        raise InputError(InputMistake(f"{what}; expected a plain file to lock: remove it{hint}", path)) from error
    mode = os.fstat(lock).st_mode
    if not stat.S_ISREG(mode):
        os.close(lock)
        raise InputError(
            InputMistake(f"is {_describe_file_type(mode)}; expected a plain file to lock: remove it{hint}", path)
        )
    return lock


_BLOCKING_ERRNOS = {errno.EACCES, errno.EPERM, errno.EISDIR, errno.ELOOP, errno.ENXIO, errno.ENODEV, errno.EOPNOTSUPP}


def _describe_file_type(mode: int) -> str:
    """Describe the type of a file that is not a regular file."""
    kinds = {stat.S_IFIFO: "a pipe", stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def is_file_name(text: str) -> bool:
    """Return whether a text is a valid file name, and not a path."""
    size = len(text.encode(errors="surrogateescape"))
    return 0 < size <= 240 and "/" not in text and "\0" not in text and text not in (".", "..")


def sanitise_name(text: str) -> str:
    """Convert a text to a safe file name of letters, digits, `.`, `_` and `-`."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip("._")[:200] or "_"


def get_user_cache_dir(name: str) -> Path:
    """Return the user's cache folder for one kind of file; it may not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "springbench" / name


USER_ERRNOS = {
    *(errno.EACCES, errno.EEXIST, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG, errno.ENODEV, errno.ENOENT),
    *(errno.ENOTDIR, errno.ENXIO, errno.EOPNOTSUPP, errno.EPERM, errno.EROFS),
}
"""Error numbers that indicate a mistake of the user in a path."""


def describe_os_error(error: OSError) -> str:
    """Describe a system error as a message with its file and cause."""
    names = " and ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
    return f"{names or 'a file'}: {describe_cause(error)}"


def build_write_error(path: Path, error: Exception) -> WriteError:
    """Build the error for a file that cannot be written.

    Args:
        path: the file.
        error: cause, which the message states after the path.
    """
    return WriteError(f"{path}: cannot be written: {describe_cause(error)}")


def describe_cause(error: Exception) -> str:
    """Describe the cause of an error.

    The system's words are used if possible, such as `No space left on device`, else the error's own.
    """
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else " ".join(str(error).split()) or type(error).__name__


HEAD_BYTES = 1024
"""Number of leading bytes that `describe_misnamed_file` examines."""


def describe_misnamed_file(head: bytes, size: int) -> str:
    """Describe a file that has the name of a data file but other content.

    Args:
        head: first HEAD_BYTES bytes of the file.
        size: size of the file [bytes].

    Returns:
        The end of a sentence for an empty file, a Git LFS pointer or a web page; "" for any other file.
    """
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if not start and size <= len(head):
        return "is empty"
    if start.startswith(b"version https://git-lfs.github.com/spec/"):
        return "is a Git LFS pointer; run `git lfs pull` to get the file itself"
    if start.startswith((b"<!doctype html", b"<html")):
        return "is a web page; download the file itself"
    return ""


def explain_unreadable_file(path: Path) -> str:
    """Describe why a file cannot contain data, as `describe_misnamed_file` does; "" for other files."""
    if not path.is_file():  # reading a pipe would block
        return ""
    try:
        with path.open("rb") as file:
            return describe_misnamed_file(file.read(HEAD_BYTES), path.stat().st_size)
    except OSError:
        return ""
