"""Command-line options of a run, generated from their model.

The model is imported when a command with these options is parsed, and not to list the commands.
"""

from __future__ import annotations

from inspect import Parameter, Signature
from typing import Annotated, Any

import typer
from typer.core import TyperCommand
from typer.main import get_command


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
