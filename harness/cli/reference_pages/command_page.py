"""Reference page of the command line, from its Click commands."""

from __future__ import annotations

import re
from typing import Any

import typer
from springbench.harness.cli.reference_pages.markdown_text import format_table

_BRACKET = re.compile(r"\s*\[((?:default: |required|[x\d.]+<=|x>)[^\]]*)\]$")
"""Defaults and ranges at the end of the help of a parameter."""

_INTRODUCTION = """# Commands

For users of the command line: each command with its arguments, its options and their defaults.

Exit codes: 0 success; 1 a failed run, or a regression; 2 a mistake in the input; 3 a test that cannot decide; 130
stopped by Ctrl-C. `springbench COMMAND --help` prints the same."""


def build_command_page(command: Any) -> str:
    """Build the page of all commands of a Typer group."""
    context = typer.Context(command, info_name="springbench")
    found = {name: command.get_command(context, name) for name in sorted(command.list_commands(context))}
    summary = format_table(
        ("command", "purpose"),
        ((f"[`{name}`](#{name})", one.get_short_help_str(limit=200)) for name, one in found.items()),
    )
    return "\n\n".join([_INTRODUCTION, summary, *(_describe_command(one, name) for name, one in found.items())])


def _describe_command(command: Any, name: str) -> str:
    context = typer.Context(command, info_name=f"springbench {name}")
    pieces = " ".join(command.collect_usage_pieces(context)).replace("{", "").replace("}", "")
    records = [one.get_help_record(context) for one in command.get_params(context)]
    rows = [_split_record(*record) for record in records if record and "--help" not in record[0]]
    parts = [f"## {name}", f"`springbench {name} {pieces}`", command.help or ""]
    if rows:
        parts.append(format_table(("argument or option", "default", "meaning"), rows))
    return "\n\n".join(parts)


def _split_record(name: str, text: str) -> tuple[str, str, str]:
    """Split the help of a parameter into its name, its default and its meaning."""
    meaning, default = " ".join(text.split()), ""
    if found := _BRACKET.search(meaning):
        meaning = meaning[: found.start()]
        values = [part.strip() for part in found[1].split(";")]
        ranges = ", ".join(part for part in values if not part.startswith(("default:", "required")))
        meaning = f"{meaning} ({ranges})" if ranges else meaning
        default = next((f"`{part.removeprefix('default: ')}`" for part in values if part.startswith("default:")), "")
        default = "required" if "required" in values else default
    return f"`{name}`", default, meaning
