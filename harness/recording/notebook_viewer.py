"""Rerun's viewer of a recording in the output of a notebook cell."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from springbench.harness.errors import InputError
from springbench.harness.execution.optional_parts import NOTEBOOKS


@dataclass(frozen=True, slots=True)
class NotebookViewer:
    """Rerun's viewer of a recording, which a notebook displays.

    The file is read each time the viewer is displayed: a widget sends its data to the first display only.

    Attributes:
        path: path of the recording.
        width: width in pixels, or "auto" for that of the cell.
        height: height in pixels.
    """

    path: Path
    width: int | Literal["auto"]
    height: int

    def __post_init__(self) -> None:
        if not NOTEBOOKS.is_installed():
            raise InputError(NOTEBOOKS.describe_absence())

    def _ipython_display_(self) -> None:
        from IPython.display import display  # pyright: ignore[reportUnknownVariableType]
        from rerun_notebook import ErrorWidget, Viewer  # pyright: ignore[reportMissingTypeStubs]

        viewer = Viewer(width=self.width, height=self.height)
        viewer.send_rrd(self.path.read_bytes())
        display(ErrorWidget())  # shows a message if the browser cannot load the viewer
        display(viewer)
