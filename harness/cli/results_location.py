"""Locations of results on the command line: a local folder or a remote URL."""

from __future__ import annotations

from pathlib import Path

import typer
from springbench.harness.results.remote_storage import RemoteStorage


def parse_location(value: str | Path) -> Path | str:
    """Parse a path or URL of results; a URL remains text."""
    if "\0" in str(value):
        raise typer.BadParameter("contains NUL, which no path and no URL can")
    return value if isinstance(value, Path) or "://" in value else Path(value)


def sync_results(context: typer.Context, value: Path | str) -> Path:
    """Download all results before a command, and upload its changes when it ends.

    Args:
        context: context of the command.
        value: local path or URL.

    Returns:
        The local folder.
    """
    if isinstance(value, Path):
        return value
    place = RemoteStorage.from_url(value)
    place.download_changes()
    context.call_on_close(place.upload_changes)
    return place.folder


def fetch_rows(value: Path | str) -> Path:
    """Download the rows of results, and return the local folder.

    It is for a command that writes nothing.
    """
    if isinstance(value, Path):
        return value
    place = RemoteStorage.from_url(value)
    place.download_changes(only_rows=True)
    return place.folder
