"""Start of commands before Typer is imported, which takes longer than `list`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module

from springbench.harness.cli.error_reports import report_errors
from springbench.harness.execution.optional_parts import PICTURES
from springbench.harness.report.drawing_preload import preload_drawing
from springbench.harness.report.figures.figure_options import MESH_KINDS


def start_early(arguments: Sequence[str]) -> bool:
    """Start a command, and return whether it is complete.

    `list` and `schema` without arguments are complete. For `query`, the process that executes it starts; for
    `figure`, `preview` and `run --rerun`, the one that draws.

    Args:
        arguments: command and its arguments.
    """
    with report_errors():
        match arguments:
            case ["list"]:
                from springbench.harness.cli.source_texts import print_names

                print_names()
            case ["schema"]:
                from springbench.harness.cli.source_texts import print_schema

                print_schema()
            case ["query", *_]:
                from springbench.harness.execution.sandbox import prepare_call
                from springbench.harness.report.sql_query import EXECUTE_QUERY

                prepare_call(EXECUTE_QUERY)
                return False
            case ["figure", _, _, *_] if MESH_KINDS.isdisjoint(arguments):
                _start_drawing(_preload_figures)
                return False
            case ["preview", _, *_] if PICTURES.is_installed():
                _start_drawing(_preload_preview)
                return False
            case ["run", *_] if _draws_for_certain(arguments):
                _start_drawing(preload_drawing)
                return False
            case _:
                return False
    return True


def _start_drawing(preload: Callable[[], object]) -> None:
    """Start the process that draws, which imports its libraries while this process continues."""
    from springbench.harness.execution.early_worker import start_early_worker

    start_early_worker(preload)


def _draws_for_certain(arguments: Sequence[str]) -> bool:
    """Return whether a command `run` repeats its runs, and thus draws them again."""
    return "--rerun" in arguments and PICTURES.is_installed() and not any(a.startswith("--error") for a in arguments)


def _preload_figures() -> None:
    from springbench.harness.report.figures import figure_drawing

    figure_drawing.preload_drawing()


def _preload_preview() -> None:
    from springbench.harness.report import opengl_probe

    opengl_probe.start_opengl_probe()
    import_module("springbench.harness.report.scene_preview")
