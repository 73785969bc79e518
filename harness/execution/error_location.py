"""Locate errors in source code, from exceptions and from the dumps of crashed processes."""

from __future__ import annotations

import re
import traceback
from collections.abc import Collection
from pathlib import Path

from springbench.solvers.jit import source_digest


def format_error(error: BaseException) -> str:
    """Format the type and the message of an error in one line.

    The message has at most 300 characters. If an exception of user code fails to produce its message, a
    placeholder replaces it.
    """
    try:
        words = " ".join(str(error).split())[:300]
    except Exception:
        words = "its message cannot be had"
    return f"{type(error).__name__}{f': {words}' if words else ''}"


def locate_error(error: BaseException, user_files: Collection[str]) -> str:
    """Return `file:line` of an error.

    The line is the last one in `user_files`, else the last one in any user code, else the line that raised the error.
    That line is appended if it is another one.

    Args:
        error: exception with a traceback.
        user_files: paths of the user's source files.

    Returns:
        The location, such as `mine.py:12, raised in core.py:40`.
    """
    frames = [(frame.filename, frame.lineno or 0) for frame in traceback.extract_tb(error.__traceback__)]
    theirs = [frame for frame in frames if not source_digest.is_known_source(frame[0])]
    blamed = [frame for frame in frames if frame[0] in user_files] or theirs or frames
    places = [f"{Path(file).name}:{line}" for file, line in dict.fromkeys((blamed[-1], frames[-1]))]
    return ", raised in ".join(places)


def parse_fault_location(dump: str) -> str:
    """Return `file:line in function` from a dump of `faulthandler`.

    The dump lists the innermost frame first. The first frame in user code is preferred, else the first frame is used.

    Returns:
        The location, or "" if the dump has no frames.
    """
    frames = re.findall(r'File "(.+?)", line (\d+) in (\S+)', dump)
    if not frames:
        return ""
    file, line, function = next((frame for frame in frames if not source_digest.is_known_source(frame[0])), frames[0])
    return f"{Path(file).name}:{line} in {function}"
