"""Start of commands before Typer is imported, which takes longer than `list`."""

from __future__ import annotations

from collections.abc import Sequence

from springbench.harness.cli.error_reports import report_errors


def start_early(arguments: Sequence[str]) -> bool:
    """Start a command, and return whether it is complete.

    `list` and `schema` without arguments are complete. For `query`, the process that executes it starts; for
    commands that draw or record, the one that does so.

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
            case ["figure" | "preview" | "run", *_]:
                from springbench.harness.cli.early_drawing import start_drawing

                start_drawing(arguments)
                return False
            case _:
                return False
    return True
