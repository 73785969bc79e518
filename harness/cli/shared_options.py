"""Shared command-line options, and a command group that reports errors without a traceback."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from springbench.harness.atomic_files import USER_ERRNOS, describe_os_error
from springbench.harness.console import enable_logging, print_message
from springbench.harness.errors import SpringbenchError
from springbench.harness.results import remote_storage
from typer.core import TyperGroup

_RESULTS_SETTINGS: Any = {
    "parser": remote_storage.parse_location,
    "metavar": "PATH|URL",
    "help": "The folder that holds a folder for each sweep.",
}
ResultsOption = Annotated[Path, typer.Option(callback=remote_storage.sync_results, **_RESULTS_SETTINGS)]
RowsOption = Annotated[Path, typer.Option(callback=remote_storage.fetch_rows, **_RESULTS_SETTINGS)]
RerunOption = Annotated[bool, typer.Option("--rerun", help="Do all, also what is there.")]
RerunStaleOption = Annotated[
    bool, typer.Option("--rerun-stale", help="Do also what is there by other code than today's.")
]
InProcessOption = Annotated[
    bool, typer.Option("--in-process", help="Do all in this process, without limits, as a debugger wants it.")
]
ErrorOption = Annotated[
    float | None,
    typer.Option("--error", help="For a scene: its relative error at the end; solver and steps are chosen."),
]
EndTimeOption = Annotated[float | None, typer.Option(help="With --error: simulated seconds; all frames if left out.")]
VerifyOption = Annotated[bool, typer.Option("--verify", help="With --error: let the reference grade it.")]
CompareOption = Annotated[
    bool, typer.Option("--compare", help="With --error: time other libraries' integrators beside it.")
]


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
        except BrokenPipeError:  # whoever read the answer has read enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except OSError as error:
            print_message(f"springbench: {describe_os_error(error)}")
            raise typer.Exit(2 if error.errno in USER_ERRNOS else 1) from error
        except MemoryError as error:
            print_message("springbench: there is not enough memory for this; take a smaller mesh")
            raise typer.Exit(1) from error
