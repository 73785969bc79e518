"""Shared command-line options, generated options of runs, and a command group that reports errors."""

from __future__ import annotations

import os
from inspect import Parameter, Signature
from pathlib import Path
from typing import Annotated, Any

import typer
from springbench.harness.cli import results_location
from springbench.harness.cli.error_reports import report_errors
from springbench.harness.config.shipped_configs import locate_config
from springbench.harness.errors import InputError
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

SCENE_HELP = "Scene (YAML), or scene of the assignment (JSON), or name of a shipped scene."


def describe_config(metavar: str, help_text: str) -> Any:
    """Describe an argument that is a config, by file or by shipped name.

    Args:
        metavar: name of the argument in the usage line.
        help_text: help of the argument.

    Returns:
        The annotation of Typer, which converts the argument to a path.
    """
    return typer.Argument(parser=locate_config, metavar=metavar, help=help_text)


_RESULTS_SETTINGS: Any = {
    "parser": results_location.parse_location,
    "metavar": "PATH|URL",
    "help": "Folder with a subfolder for each sweep.",
}
ResultsOption = Annotated[Path, typer.Option(callback=results_location.sync_results, **_RESULTS_SETTINGS)]
RowsOption = Annotated[Path, typer.Option(callback=results_location.fetch_rows, **_RESULTS_SETTINGS)]
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
    """Require that an output file can be written at the path of an option.

    Args:
        path: path of the file; None for no file, which is valid.
        suffix: required suffix, with its dot.
        option: name of the option, for the message.

    Raises:
        InputError: the suffix is another, the folder does not exist, or the path is no file.
    """
    if path and (path.suffix != suffix or not path.parent.is_dir() or (os.path.lexists(path) and not path.is_file())):
        raise InputError(f"{option}: got {path}; expected a file that ends in {suffix}, in a folder that exists")


class ErrorReportingGroup(TyperGroup):
    """Command group that reports expected errors."""

    def invoke(self, ctx: Any) -> Any:
        with report_errors():
            return super().invoke(ctx)


def build_command_class(*names: str) -> type[TyperCommand]:
    """Build a command class that also accepts options of a run.

    The values are parsed as in a file and passed in `obj` of the command's context.

    Args:
        names: options to add; all of them if empty.
    """

    class Taking(TyperCommand):
        _added: tuple[str, ...] = ()

        def get_params(self, ctx: Any) -> Any:
            if not self._added:
                options = _build_options(names)
                self._added = tuple(option.name for option in options)
                self.params = [*self.params, *options]
            return super().get_params(ctx)

        def invoke(self, ctx: Any) -> Any:
            from springbench.harness.schema.yaml_loader import parse_scalar

            given = {name: ctx.params.pop(name) for name in self._added}
            ctx.obj = {name: parse_scalar(text) for name, text in given.items() if text is not None}
            return super().invoke(ctx)

    return Taking


def _build_options(names: tuple[str, ...]) -> list[Any]:
    """Build the options that Typer creates for a function with such parameters."""
    from springbench.harness.config.run_options import RUN_OPTIONS, describe_option

    def function() -> None: ...

    given_options = {
        name: typer.Option(help=f"For a scene: {describe_option(name)}", metavar="VALUE")
        for name in names or RUN_OPTIONS
    }
    stated = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[str | None, option])
        for name, option in given_options.items()
    ]
    vars(function)["__signature__"] = Signature(stated)
    app = typer.Typer(add_completion=False)
    app.command()(function)
    return list(get_command(app).params)
