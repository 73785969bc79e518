"""Deferral of pandas in the processes of a command.

PyArrow imports pandas as soon as it builds an array, to recognise data frames. That takes 0.3 s, and no command uses
data frames. `to_pandas` still imports pandas.
"""

from __future__ import annotations

import sys

_is_requested = False


def request_deferral() -> None:
    """Request that `defer_pandas` takes effect in this process and its forks.

    Only for processes that run no other program.
    """
    global _is_requested
    _is_requested = True


def defer_pandas() -> None:
    """Prevent PyArrow from importing pandas until a data frame is requested.

    Does nothing without `request_deferral`, or if pandas is imported already.
    """
    if not _is_requested or "pandas" in sys.modules:
        return
    import pyarrow as pa

    sys.meta_path.insert(0, _PandasHider)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(_PandasHider)


class _PandasHider:
    """Finder of modules that finds no pandas."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> None:
        if name == "pandas":
            raise ModuleNotFoundError(name=name)
