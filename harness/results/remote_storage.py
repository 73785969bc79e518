# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# fsspec has no types.
"""Remote storage of results, by URL (fsspec): `s3://bucket/results`, `sftp://host/results`, `memory://...`

Commands work on a local folder in the user's cache, one per URL. Remote changes are downloaded before a command, and
local changes are uploaded when it ends, even after an error. If a kill prevents the upload, the next command repeats
it. An index stores both states at the last synchronisation. If one side has changed since, the other side is updated;
if both have, the local version is uploaded.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from springbench.harness.atomic_files import atomic_write, get_user_cache_dir
from springbench.harness.errors import InputError, InputMistake, RunFailed
from springbench.harness.results.row_store import TABLE_FOLDERS

_BATCH_SIZE = 500
"""Number of files per transfer."""
INDEX_FILE = ".place.json"
"""Name of the index file in the local folder."""


@dataclass(slots=True)
class RemoteStorage:
    """A URL and its local folder.

    Attributes:
        url: URL as the user gave it.
        folder: local folder in the user's cache.
        filesystem: file system of fsspec.
        root: path of the results on that file system.
        index: by file name, the remote and the local token at the last synchronisation.
    """

    url: str
    folder: Path
    filesystem: Any
    root: str
    index: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    @classmethod
    def from_url(cls, url: str) -> RemoteStorage:
        """Create the storage of a URL.

        Raises:
            InputError: if its scheme is unknown or its package is missing.
        """
        from fsspec.core import url_to_fs

        try:
            system, root = url_to_fs(url)
        except (ValueError, ImportError, TypeError) as error:
            hint = "; pip install 'springbench[s3]'" if url.startswith("s3:") else ""
            raise InputError(InputMistake(f"{error}{hint}", key=url)) from error
        folder = get_user_cache_dir("places") / hashlib.sha256(url.rstrip("/").encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        place = cls(url, folder, system, str(root).rstrip("/"))
        with suppress(OSError, ValueError):
            place.index = json.loads((folder / INDEX_FILE).read_text())
        return place

    def download_changes(self, *, only_rows: bool = False) -> None:
        """Download changed files, and remove local files that were deleted remotely and are unchanged here.

        Args:
            only_rows: whether to download only files of rows.

        Raises:
            InputError: if the storage cannot be read.
        """
        try:
            self.filesystem.invalidate_cache()
            there = self._list_remote()
            expected = {n: token for n, token in there.items() if not only_rows or _is_row_file(n)}
            new = [n for n, token in expected.items() if self.index.get(n, [""])[0] != token]
            new = [n for n in new if self._local_token(n) in ("", self.index.get(n, ["", ""])[1])]
            for start in range(0, len(new), _BATCH_SIZE):
                self._download_files(new[start : start + _BATCH_SIZE], there)
        except Exception as error:  # each storage library has exceptions of its own
            raise InputError(InputMistake(f"cannot be read: {_format_error(error)}", key=self.url)) from error
        for name in [name for name in self.index if name not in there]:
            if self._local_token(name) == self.index.pop(name)[1]:
                (self.folder / name).unlink(missing_ok=True)
        self._save_index()

    def _download_files(self, names: Sequence[str], there: Mapping[str, str]) -> None:
        """Download some files in one transfer; an interrupted transfer is repeated later."""
        with TemporaryDirectory(dir=self.folder, prefix=".partial") as scratch:
            fetched = [Path(scratch) / str(number) for number in range(len(names))]
            self.filesystem.get([f"{self.root}/{name}" for name in names], [str(path) for path in fetched])
            for name, path in zip(names, fetched, strict=True):
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(path, self.folder / name)
                self.index[name] = [there[name], self._local_token(name)]
        self._save_index()

    def upload_changes(self) -> None:
        """Upload changed files, then delete remote files that were deleted here.

        Raises:
            RunFailed: if the storage cannot be written; the local files remain, and are uploaded later.
        """
        names = {path.relative_to(self.folder).as_posix() for path in self.folder.rglob("*") if _is_result_file(path)}
        new = [name for name in sorted(names) if self.index.get(name, ["", ""])[1] != self._local_token(name)]
        gone = [name for name in self.index if not (self.folder / name).exists()]
        if not new and not gone:
            return
        try:
            for start in range(0, len(new), _BATCH_SIZE):
                batch = new[start : start + _BATCH_SIZE]
                for above in {str(PurePosixPath(f"{self.root}/{name}").parent) for name in batch}:
                    self.filesystem.makedirs(above, exist_ok=True)
                # Tokens are taken before the transfer, so that a change during it is uploaded by the next command.
                self.index |= {name: ["", self._local_token(name)] for name in batch}
                self.filesystem.put([str(self.folder / n) for n in batch], [f"{self.root}/{n}" for n in batch])
            for name in gone:
                self.filesystem.rm_file(f"{self.root}/{name}")
                del self.index[name]
            self.filesystem.invalidate_cache()
            there = self._list_remote()
        except Exception as error:  # each storage library has exceptions of its own
            raise RunFailed(
                f"{self.url}: cannot be written: {_format_error(error)}; all results remain "
                f"in {self.folder}, and the next command "
                "with this URL sends it"
            ) from error
        for name in new:
            self.index[name][0] = there[name]
        self._save_index()

    def _list_remote(self) -> dict[str, str]:
        """List the remote files with a token that changes when they do."""
        found: Mapping[str, Mapping[str, Any]] = self.filesystem.find(self.root, detail=True)
        start = len(self.root.strip("/")) + 1
        files = {name.strip("/")[start:]: about for name, about in found.items()}
        return {name: _remote_token(about) for name, about in files.items() if _is_safe_name(name)}

    def _local_token(self, name: str) -> str:
        """Return a token that changes when a local file changes; "" if it is missing."""
        try:
            about = (self.folder / name).stat()
        except FileNotFoundError:
            return ""
        return f"{about.st_size} {about.st_mtime_ns}"

    def _save_index(self) -> None:
        with atomic_write(self.folder / INDEX_FILE) as partial:
            partial.write_text(json.dumps(self.index))


def _remote_token(about: Mapping[str, Any]) -> str:
    version = next((about[key] for key in ("ETag", "etag", "LastModified", "mtime", "created") if about.get(key)), "")
    return f"{about.get('size')} {version}"


def _is_safe_name(name: str) -> bool:
    """Return whether a name stays inside the folder and is not the index."""
    parts = PurePosixPath(name).parts
    return bool(parts) and ".." not in parts and not name.startswith("/") and name != INDEX_FILE


_INTERNAL_FILES = (INDEX_FILE, ".lock", ".claims")


def _is_result_file(path: Path) -> bool:
    return path.is_file() and path.name not in _INTERNAL_FILES and not any("partial" in part for part in path.parts)


def _is_row_file(name: str) -> bool:
    path = PurePosixPath(name)
    return path.suffix == ".parquet" and (path.parent.name in TABLE_FOLDERS or path.stem in TABLE_FOLDERS)


def _format_error(error: Exception) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__
