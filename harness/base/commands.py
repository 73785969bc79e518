"""Shared command-line options, and a command group that reports errors without a traceback."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from harness.base import places
from harness.base.console import say, show_log
from harness.base.errors import SpringbenchError
from harness.base.files import MISTAKES, told

_RESULTS: Any = {
    "parser": places.parse,
    "metavar": "PATH|URL",
    "help": "The folder that holds a folder for each sweep.",
}
Results = Annotated[Path, typer.Option(callback=places.everything, **_RESULTS)]
Rows = Annotated[Path, typer.Option(callback=places.rows_alone, **_RESULTS)]
Again = Annotated[bool, typer.Option("--again", help="Do all, also what is there.")]
Changed = Annotated[bool, typer.Option("--changed", help="Do also what is there by other code than today's.")]
InThisProcess = Annotated[
    bool, typer.Option("--here", help="Do all in this process, without limits, as a debugger wants it.")
]
Error = Annotated[
    float | None,
    typer.Option(help="For a scene: the error wanted at its end, relative to the displacement; how, is chosen."),
]
Horizon = Annotated[float | None, typer.Option(help="With --error: simulated seconds; all frames if left out.")]
Check = Annotated[bool, typer.Option("--check", help="With --error: let the reference grade it.")]
Peers = Annotated[bool, typer.Option("--peers", help="With --error: time other libraries' integrators beside it.")]


class Commands(TyperGroup):
    """Command group that reports expected errors as a message and an exit code.

    These are the project's own errors and those of the system.
    """

    def invoke(self, ctx: Any) -> Any:
        show_log()
        try:
            return super().invoke(ctx)
        except SpringbenchError as error:
            for mistake in getattr(error, "mistakes", (error,)):
                say(f"springbench: {mistake}")
            raise typer.Exit(error.exit_code) from error
        except BrokenPipeError:  # whoever read the answer has read enough
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except OSError as error:
            say(f"springbench: {told(error)}")
            raise typer.Exit(2 if error.errno in MISTAKES else 1) from error
        except MemoryError as error:
            say("springbench: there is not enough memory for this; take a smaller mesh")
            raise typer.Exit(1) from error
