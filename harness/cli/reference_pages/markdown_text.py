"""Markdown of reference pages: tables, anchors and docstrings."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Sequence

_SECTION = re.compile(r"(Args|Returns|Raises|Yields|Attributes|Example):\s*(.*)")


def format_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a table in Markdown.

    Args:
        header: titles of the columns.
        rows: cells of each row; the lines of a cell are joined.
    """
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(_escape_cell, line)) + " |" for line in lines)


def _escape_cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def build_anchor(heading: str) -> str:
    """Build the anchor that GitHub gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def format_docstring(docstring: str | None, *, with_arguments: bool = True) -> str:
    """Format a docstring in Google style: its sections become lists, its examples become code.

    Args:
        docstring: text of the docstring.
        with_arguments: whether to include the section `Args`.
    """
    parts: list[str] = []
    for section, text in _split_sections(docstring):
        if section == "Example":
            parts.append(f"```python\n{text}\n```")
        elif section in ("Args", "Raises", "Attributes"):
            if section != "Args" or with_arguments:
                listed = (f"* `{name}`: {meaning}" for name, meaning in _read_entries(text).items())
                parts.append(f"*{section}:*\n\n" + "\n".join(listed))
        else:
            parts.append(f"*{section}:* {' '.join(text.split())}" if section else text)
    return "\n\n".join(parts)


def read_section_entries(docstring: str | None, section: str) -> dict[str, str]:
    """Read the texts of the entries of a section by name.

    An entry of several names gives each of them the same text.

    Args:
        docstring: text of the docstring.
        section: title, such as `Args` or `Attributes`.
    """
    return {
        name: text
        for title, body in _split_sections(docstring)
        if title == section
        for names, text in _read_entries(body).items()
        for name in re.split(", | and ", names)
    }


def _split_sections(docstring: str | None) -> list[tuple[str, str]]:
    """Split a docstring into its text, with the title "", and its titled sections."""
    sections: list[tuple[str, list[str]]] = [("", [])]
    for line in inspect.cleandoc(docstring or "").splitlines():
        if found := _SECTION.fullmatch(line):
            sections.append((found[1], [found[2]] if found[2] else []))
        else:
            if sections[-1][0] and line and not line.startswith(" "):
                sections.append(("", []))
            sections[-1][1].append(line)
    texts = (
        (title, inspect.cleandoc("\n" + "\n".join(lines)) if title != "Returns" else "\n".join(lines))
        for title, lines in sections
    )
    return [(title, text.strip()) for title, text in texts if text.strip()]


def _read_entries(text: str) -> dict[str, str]:
    """Read the entries `name: text` of a section; further lines of an entry are indented."""
    entries: list[str] = []
    for line in text.splitlines():
        if line.startswith(" ") and entries:
            entries[-1] += f" {line.strip()}"
        else:
            entries.append(line.strip())
    pairs = (entry.partition(": ") for entry in entries)
    return {name: meaning for name, _, meaning in pairs}
