"""The options of a run on the command line, made of the model that states them.

The model is imported when a command that takes them is asked, and not to list the commands.
"""

from __future__ import annotations

from inspect import Parameter, Signature
from typing import Annotated, Any

import typer
from typer.core import TyperCommand
from typer.main import get_command


def taking(*names: str) -> type[TyperCommand]:
    """A command that takes these options of a run too, all without names. It finds what was given in `obj` of its
    context; a value means there what it means in a file."""

    class Taking(TyperCommand):
        _added: tuple[str, ...] = ()

        def get_params(self, ctx: Any) -> Any:
            if not self._added:
                options = _options(names)
                self._added = tuple(option.name for option in options)
                self.params = [*self.params, *options]
            return super().get_params(ctx)

        def invoke(self, ctx: Any) -> Any:
            from harness.base.yaml import scalar

            given = {name: ctx.params.pop(name) for name in self._added}
            ctx.obj = {name: scalar(text) for name, text in given.items() if text is not None}
            return super().invoke(ctx)

    return Taking


def _options(names: tuple[str, ...]) -> list[Any]:
    """As Typer makes them of a function that has them as parameters."""
    from harness.config.options import OPTIONS, meaning

    def function() -> None: ...

    told = {name: typer.Option(help=f"For a scene: {meaning(name)}", metavar="VALUE") for name in names or OPTIONS}
    stated = [
        Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[str | None, option])
        for name, option in told.items()
    ]
    vars(function)["__signature__"] = Signature(stated)
    app = typer.Typer(add_completion=False)
    app.command()(function)
    return list(get_command(app).params)
