"""Shared command-line options, and a command group that reports errors without a traceback."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from springbench.harness.atomic_files import USER_ERRNOS, describe_os_error
from springbench.harness.config.shipped_configs import locate_config
from springbench.harness.console import enable_logging, print_message
from springbench.harness.errors import InputError, SpringbenchError
from springbench.harness.execution.optional_parts import find_part
from springbench.harness.results import remote_storage
from typer.core import TyperGroup

SCENE_HELP = "Scene (YAML), or scene of the assignment (JSON), or name of a shipped scene."


def describe_config(metavar: str, help_text: str) -> Any:
    """Describe an argument that is a config: a file, or the name of a shipped one."""
    return typer.Argument(parser=locate_config, metavar=metavar, help=help_text)


_RESULTS_SETTINGS: Any = {
    "parser": remote_storage.parse_location,
    "metavar": "PATH|URL",
    "help": "Folder with a subfolder for each sweep.",
}
ResultsOption = Annotated[Path, typer.Option(callback=remote_storage.sync_results, **_RESULTS_SETTINGS)]
RowsOption = Annotated[Path, typer.Option(callback=remote_storage.fetch_rows, **_RESULTS_SETTINGS)]
RerunOption = Annotated[bool, typer.Option("--rerun", help="Repeat completed runs.")]
RerunStaleOption = Annotated[
    bool,
    typer.Option("--rerun-stale", help="Repeat completed runs whose results are stale: their source code has changed."),
]
InProcessOption = Annotated[
    bool, typer.Option("--in-process", help="Run in this process, without limits of time and memory, for debugging.")
]
ErrorOption = Annotated[
    float | None,
    typer.Option("--error", help="For a scene: relative error of the final positions; selects solver and steps."),
]
EndTimeOption = Annotated[float | None, typer.Option(help="With --error: simulated time [s]; all frames by default.")]
VerifyOption = Annotated[
    bool, typer.Option("--verify", help="With --error: measure the error against the reference solution.")
]
CompareOption = Annotated[
    bool, typer.Option("--compare", help="With --error: also time integrators of other libraries.")
]


def require_output_file(path: Path | None, suffix: str, option: str) -> None:
    """Raise InputError unless a file with this suffix can be written at a path of an option; None is no file."""
    if path and (path.suffix != suffix or not path.parent.is_dir() or (os.path.lexists(path) and not path.is_file())):
        raise InputError(f"{option}: came {path}; wanted a file that ends in {suffix}, in a folder that exists")


class ErrorReportingGroup(TyperGroup):
    """Command group that reports expected errors as a message and an exit code.

    These are the project's own errors and those of the system.
    """

    def invoke(self, ctx: Any) -> Any:
        enable_logging()
        try:
            return super().invoke(ctx)
        except SpringbenchError as error:
            for mistake in getattr(error, "mistakes", (error,)):
                print_message(f"springbench: {mistake}")
            raise typer.Exit(error.exit_code) from error
        except ModuleNotFoundError as error:
            part = find_part(error)
            if part is None:
                raise
            print_message(f"springbench: {part.describe_absence()}")
            raise typer.Exit(InputError.exit_code) from error
        except BrokenPipeError:  # the reader of the output closed the pipe
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except OSError as error:
            print_message(f"springbench: {describe_os_error(error)}")
            raise typer.Exit(2 if error.errno in USER_ERRNOS else 1) from error
        except MemoryError as error:
            print_message("springbench: there is not enough memory for this; take a smaller mesh")
            raise typer.Exit(1) from error
