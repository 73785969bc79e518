"""Where in the code something went wrong: of an error, and of what a process that died has written down."""

from __future__ import annotations

import re
import traceback
from collections.abc import Collection
from pathlib import Path

from solvers import sources


def said(error: BaseException) -> str:
    """The type of an error and its message in one line, cut to a length that fits; other people's may fail to tell."""
    try:
        words = " ".join(str(error).split())[:300]
    except Exception:
        words = "its message cannot be had"
    return f"{type(error).__name__}{f': {words}' if words else ''}"


def where(error: BaseException, own: Collection[str]) -> str:
    """`file:line` of an error: the last line in the files `own`, else in those of other people, else of all; with the
    line that raised it behind that, where it is another."""
    frames = [(frame.filename, frame.lineno or 0) for frame in traceback.extract_tb(error.__traceback__)]
    theirs = [frame for frame in frames if not sources.known(frame[0])]
    blamed = [frame for frame in frames if frame[0] in own] or theirs or frames
    told = [f"{Path(file).name}:{line}" for file, line in dict.fromkeys((blamed[-1], frames[-1]))]
    return ", raised in ".join(told)


def place(dump: str) -> str:
    """`file:line in function` of what `faulthandler` wrote down, the innermost first: the first one in other people's
    files, else the first; "" where there is none."""
    frames = re.findall(r'File "(.+?)", line (\d+) in (\S+)', dump)
    if not frames:
        return ""
    file, line, function = next((frame for frame in frames if not sources.known(frame[0])), frames[0])
    return f"{Path(file).name}:{line} in {function}"
