"""Publish results as one archive that others can cite, read and check.

`springbench verify` repeats some of its runs.

    results/<sweep>/       rows, recordings, pictures, pages
    configs/<sweep>/       the config, and the scenes, meshes and code that it names
    environment/           the machine, and the installed packages in the format of `pip install -r`
    CITATION.cff, ro-crate-metadata.json, SHA256SUMS

Only files in the folder of results, or in a config's folder, are included. Any other file to which a link or a config
points is an error that names it. The archive unpacks to a folder of results on which `springbench list`, `query` and
`gate` work. The metadata follow RO-Crate 1.1 (https://w3id.org/ro/crate/1.1); the checksums are for `sha256sum -c`.
"""

from __future__ import annotations

import hashlib
import json
import mimetypes
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import distributions, version
from pathlib import Path, PurePosixPath
from typing import Any

from harness.base import machine, rows, shelf
from harness.base.claim import NAME as CLAIM
from harness.base.claim import config_of
from harness.base.document import is_list
from harness.base.errors import InputError, Mistake
from harness.base.files import replacing
from harness.base.model import Model
from harness.base.yaml import read_yaml
from harness.config.load import load_any
from harness.experiments.archive.merge import sweeps
from harness.scenes.mesh.scene_json import read_scene_json
from solvers.plugins import Plugin, found

SUMS, CRATE, CITATION = "SHA256SUMS", "ro-crate-metadata.json", "CITATION.cff"
_PACKAGE = Path(__file__).resolve().parents[2]
_KINDS = {".parquet": "application/vnd.apache.parquet", ".rrd": "application/octet-stream", ".yaml": "application/yaml"}
_BUFFER = 2**20
_ODD = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")
"""Characters that archives or checksum files do not support in file names."""

Content = Path | bytes


def publish(results: Path, archive: Path, say: Callable[[str], None], *, license: str = "") -> int:
    """Write an archive (.zip) of results, and return its number of files.

    Args:
        results: folder of results, or of one sweep.
        archive: archive to write.
        say: prints a remark.
        license: license of the results, a name or a URL.

    Raises:
        InputError: rows are damaged, or files lie outside of the folders.
        CannotWrite: the archive cannot be written.
    """
    if archive.suffix.lower() != ".zip" or archive.is_dir():
        raise InputError(Mistake("wanted the name of a file that ends in .zip", archive, key="--output"))
    if not archive.parent.is_dir():
        raise InputError(Mistake(f"there is no folder {archive.parent}; make it first", archive, key="--output"))
    content: dict[str, Content] = {}
    refused: list[Mistake] = []
    for folder in sweeps(results):
        name = "/".join(folder.relative_to(results).parts) or folder.resolve().name
        files = [file for file in _shown(folder) if file.resolve() != archive.resolve()]
        refused += [Mistake(why, file) for file in files if (why := _unfit(file, results))]
        content |= {f"results/{name}/{file.relative_to(folder).as_posix()}": file for file in files}
        config = config_of(folder)
        if config and _is_config(config):
            files = _needed(config)
            refused += [Mistake(why, file) for file in files if (why := _unfit(file, config.parent))]
            content |= {f"configs/{name}/{os.path.relpath(file, config.parent)}": file for file in files}
            way = os.path.relpath(f"configs/{name}/{config.name}", f"results/{name}")
            content[f"results/{name}/{CLAIM}"] = os.fsencode(f"{way}\n")
        else:
            gone = f"what it names as its config, {config}, is none" if config else "its config is not there any more"
            say(f"{folder}: {gone}, so nobody can do its runs again")
    odd = "its name is no UTF-8, or breaks a line; rename it"
    refused += [Mistake(odd, Path(name)) for name in content if _ODD.search(name)]
    if refused:
        raise InputError(refused)
    for folder in sweeps(results):
        rows.read(shelf.units(folder / "rows"))  # names what is damaged
    content |= {"environment/machine.json": _environment(), "environment/requirements.txt": _requirements()}
    if citation := next((p for p in (_PACKAGE.parent / CITATION, _PACKAGE / CITATION) if p.is_file()), None):
        content[CITATION] = citation
    with replacing(archive) as partial:
        _write(partial, content, results.resolve().name, license)
    return len(content) + 2


def _shown(folder: Path) -> Iterator[Path]:
    """Yield the files of a sweep's results that are intended for readers."""
    for path in sorted(folder.rglob("*")):
        place = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in place.parts)
        if (path.is_file() or path.is_symlink()) and not hidden and place.parts[0] != "build":
            yield path


def _unfit(path: Path, folder: Path) -> str:
    """Return why a file is excluded.

    The result is empty if it lies in the folder after resolving all links.
    """
    place = path.resolve()
    if not place.is_relative_to(folder.resolve()):
        leads = f"leads to {place}, which lies" if path.is_symlink() else "lies"
        return f"{leads} outside of {folder}; put what is to be published into that folder"
    return "" if place.is_file() else "is a link to what is no file; remove it"


def _is_config(path: Path) -> bool:
    """Return whether a file is a config of any kind.

    Results from elsewhere may name any file as theirs.
    """
    if path.suffix.lower() == ".json":
        with suppress(InputError):
            return bool(read_scene_json(path))
    with suppress(InputError):
        return path.suffix.lower() in (".yaml", ".yml") and bool(_KEYS & set(read_yaml(path).data))
    return False


_KEYS = {"scenes", "mesh", "curves", "work", "goals"}
"""A required key of each kind of config."""


def _needed(config: Path) -> list[Path]:
    """Return a config and the files that it names, without running its code."""
    files = {config}
    with suppress(InputError):  # a config of another kind, or one that was changed; it goes along all the same
        sweep = load_any(config, opens=False)
        plugins = found(sweep.reports)
        for run in sweep.runs():
            scene = run.scene
            files.add(scene.path)
            if scene.path.suffix.lower() == ".json":
                files.add(scene.path.parent / read_scene_json(scene.path).obj)
            for part in (scene.mesh, *scene.effects):
                if isinstance(part, Model):  # what is somebody's own is not opened
                    files |= {value for value in vars(part).values() if isinstance(value, Path)}
            for _, given in scene.own.values():  # names of files come with their digests there
                there = scene.path.parent
                files |= {there / value[0] for value in given.values() if _is_file(value, there)}
            plugins += run.own()
        files |= {Path(plugin.source) for plugin in plugins if _is_beside(plugin)}
    return sorted({Path(os.path.abspath(path)) for path in files})


def _is_file(value: Any, folder: Path) -> bool:
    return is_list(value) and len(value) == 2 and isinstance(value[0], str) and (folder / value[0]).is_file()


def _is_beside(plugin: Plugin) -> bool:
    return plugin.startswith("./") and Path(plugin.source).is_file()


def _environment() -> bytes:
    told = asdict(machine.describe()) | {"versions": machine.versions(), "commit": machine.commit()}
    return (json.dumps(told, indent=2, sort_keys=True, default=str) + "\n").encode()


def _requirements() -> bytes:
    return "".join(sorted({f"{d.metadata['Name']}=={d.version}\n" for d in distributions()}, key=str.lower)).encode()


def _write(path: Path, content: Mapping[str, Content], title: str, license: str) -> None:
    sums: dict[str, str] = {}
    sizes: dict[str, int] = {}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as packed:

        def put(name: str, data: Content) -> None:
            digest, size = hashlib.sha256(), 0
            of_file = isinstance(data, Path)
            info = zipfile.ZipInfo.from_file(data, name, strict_timestamps=False) if of_file else name
            with packed.open(info, "w") as into:
                for chunk in _chunks(data):
                    digest.update(chunk)
                    into.write(chunk)
                    size += len(chunk)
            sums[name], sizes[name] = digest.hexdigest(), size

        for name, data in sorted(content.items()):
            put(name, data)
        put(CRATE, (json.dumps(_crate(sums, sizes, title, license), indent=2) + "\n").encode())
        packed.writestr(SUMS, "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items())))


def _chunks(data: Content) -> Iterator[bytes]:
    if isinstance(data, bytes):
        yield data
        return
    with data.open("rb") as file:
        while chunk := file.read(_BUFFER):
            yield chunk


def _crate(sums: Mapping[str, str], sizes: Mapping[str, int], title: str, license: str) -> dict[str, Any]:
    """Build the metadata: the data set, its files, and the program that made them."""
    files = [
        {
            "@id": name,
            "@type": "File",
            "name": PurePosixPath(name).name,
            "encodingFormat": _KINDS.get(PurePosixPath(name).suffix) or mimetypes.guess_type(name)[0] or "text/plain",
            "contentSize": str(sizes[name]),
            "sha256": digest,
        }
        for name, digest in sums.items()
    ]
    program = {
        "@id": "#springbench",
        "@type": "SoftwareApplication",
        "name": "springbench",
        "softwareVersion": version("springbench"),
        "description": f"at the commit {machine.commit()}",
    }
    made = {
        "@id": "#runs",
        "@type": "CreateAction",
        "name": "The runs of these sweeps",
        "instrument": {"@id": "#springbench"},
        "object": [{"@id": name} for name in sums if name.startswith("configs/")],
        "result": [{"@id": name} for name in sums if name.startswith("results/")],
    }
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": f"springbench results: {title}",
        "description": "Measurements of implicit time stepping of mass-spring systems, with what made them",
        "datePublished": datetime.now(UTC).isoformat(timespec="seconds"),
        "license": license or "not stated; ask those who published it",
        "hasPart": [{"@id": file["@id"]} for file in files],
        "mentions": [{"@id": "#runs"}],
    }
    about = {
        "@id": CRATE,
        "@type": "CreativeWork",
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
        "about": {"@id": "./"},
    }
    return {"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": [about, root, program, made, *files]}
