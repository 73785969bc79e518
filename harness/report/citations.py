"""Citations of methods: as a line for tables and tooltips, and as BibTeX.

Rows contain a solver's reference as JSON (authors as in BibTeX, year, title, doi), so its code is not needed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from springbench.harness.atomic_files import atomic_write


def format_citation(reference: str | None) -> str:
    """Format a reference as a line: family names, year, title, doi; empty for none."""
    if not reference:
        return ""
    found = json.loads(reference)
    *others, last = _family_names(found)
    names = f"{', '.join(others)} and {last}" if others else last
    doi = f", doi:{found['doi']}" if found["doi"] else ""
    return f"{names} {found['year']}, {found['title']}{doi}"


def format_bibtex(references: Iterable[str | None]) -> str:
    """Format one BibTeX entry per distinct reference, sorted by key.

    The text is Unicode, for biber and recent BibTeX.
    """
    known = sorted(
        {reference for reference in references if reference}, key=lambda r: (_citation_key(json.loads(r)), r)
    )
    entries, keys = list[str](), [_citation_key(json.loads(reference)) for reference in known]
    for k, reference in enumerate(known):
        found = json.loads(reference)
        letter = chr(ord("a") + keys[:k].count(keys[k])) if keys.count(keys[k]) > 1 else ""
        fields = {"author": found["authors"], "title": f"{{{found['title']}}}", "year": found["year"]}
        fields |= {"doi": found["doi"]} if found["doi"] else {}
        lines = "".join(f"  {name} = {{{value}}},\n" for name, value in fields.items())
        entries.append(f"@misc{{{keys[k]}{letter},\n{lines}}}\n")
    return "\n".join(entries)


def write_bibtex(path: Path, references: Iterable[str | None]) -> Path:
    """Write the BibTeX entries and return the path.

    Args:
        path: target file.
        references: references as JSON, or None.

    Raises:
        WriteError: if the file cannot be written.
    """
    with atomic_write(path) as partial:
        partial.write_text(format_bibtex(references), encoding="utf-8")
    return path


def _family_names(entry: dict[str, Any]) -> list[str]:
    return [author.split(",")[0].strip() for author in entry["authors"].split(" and ")]


def _citation_key(entry: dict[str, Any]) -> str:
    return re.sub(r"[^a-z]", "", _family_names(entry)[0].lower()) + str(entry["year"])
