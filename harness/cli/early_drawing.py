"""Start of the process that draws or records.

It imports its libraries while the command starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module

from springbench.harness.execution.optional_parts import PICTURES, RECORDINGS
from springbench.harness.report.figures.figure_options import MESH_KINDS
from springbench.solvers.platform_calls import list_usable_cores


def start_drawing(arguments: Sequence[str]) -> None:
    """Start the process that draws or records, if the command needs it.

    On a single core it does not start early.

    Args:
        arguments: command and its arguments.
    """
    preload = _choose_preload(arguments)
    if preload and len(list_usable_cores()) > 1:
        from springbench.harness.execution.early_worker import start_early_worker

        start_early_worker(preload)


def _choose_preload(arguments: Sequence[str]) -> Callable[[], object] | None:
    """Return what imports the libraries of the pictures or recordings, or None without any."""
    match arguments:
        case ["figure", _, _, *_] if MESH_KINDS.isdisjoint(arguments):
            return _preload_figures
        case ["preview", _, *_] if PICTURES.is_installed():
            return _preload_preview
        case ["run", *_] if any(one.startswith("--error") for one in arguments):
            return _preload_recording if RECORDINGS.is_installed() else None
        case ["run", *_] if "--rerun" in arguments:
            return _preload_sweep if PICTURES.is_installed() else None
        case _:
            return None


def _preload_figures() -> None:
    from springbench.harness.report.figures.figure_drawing import preload_figures

    preload_figures()


def _preload_preview() -> None:
    from springbench.harness.report.drawing_preload import preload_preview

    preload_preview()


def _preload_sweep() -> None:
    from springbench.harness.report.drawing_preload import preload_drawing

    preload_drawing()


def _preload_recording() -> None:
    import_module("springbench.harness.recording.rerun_recorder")
