"""Publish results as one archive that others can cite, read and check.

`springbench verify-archive` repeats some of its runs.

    results/<sweep>/       rows, recordings, pictures, pages
    configs/<sweep>/       the config, and the scenes, meshes and code that it names
    environment/           the machine, and the installed packages in the format of `pip install -r`
    CITATION.cff, ro-crate-metadata.json, SHA256SUMS

Only files in the folder of results, or in a config's folder, are included. Any other file to which a link or a config
points is an error that names it. The archive unpacks to a folder of results on which `springbench list` and `query`
work. The metadata follow RO-Crate 1.1 (https://w3id.org/ro/crate/1.1); the checksums are for `sha256sum -c`.
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

from springbench.harness.atomic_files import atomic_write
from springbench.harness.config.config_loader import find_config_kind, load_config
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution import machine_info
from springbench.harness.experiments.archive.result_merge import list_sweep_folders
from springbench.harness.results import parquet_rows, row_store
from springbench.harness.results.folder_ownership import OWNER_FILE as CLAIM
from springbench.harness.results.folder_ownership import read_owner
from springbench.harness.scenes.mesh.assignment_json import read_assignment_json
from springbench.harness.schema.base_model import ConfigModel
from springbench.harness.schema.config_document import is_list
from springbench.harness.schema.yaml_loader import read_yaml
from springbench.solvers.plugins.plugin_discovery import PluginName, select_plugins

CHECKSUM_FILE, CRATE_FILE, CITATION_FILE = "SHA256SUMS", "ro-crate-metadata.json", "CITATION.cff"
_PACKAGE_FOLDER = Path(__file__).resolve().parents[2]
_MEDIA_TYPES = {
    ".parquet": "application/vnd.apache.parquet",
    ".rrd": "application/octet-stream",
    ".yaml": "application/yaml",
}
_BUFFER_SIZE = 2**20
_INVALID_NAME_CHARACTERS = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")
"""Characters that archives or checksum files do not support in file names."""

FileContent = Path | bytes


def publish_results(
    results: Path, archive: Path, print_message: Callable[[str], None], *, license_text: str = ""
) -> int:
    """Write an archive (.zip) of results, and return its number of files.

    Args:
        results: folder of results, or of one sweep.
        archive: archive to write.
        print_message: prints a remark.
        license_text: license of the results, a name or a URL.

    Raises:
        InputError: rows are damaged, or files lie outside of the folders.
        WriteError: the archive cannot be written.
    """
    if archive.suffix.lower() != ".zip" or archive.is_dir():
        raise InputError(InputMistake("expected the name of a file that ends in .zip", archive, key="--output"))
    if not archive.parent.is_dir():
        raise InputError(InputMistake(f"there is no folder {archive.parent}; make it first", archive, key="--output"))
    content: dict[str, FileContent] = {}
    refused: list[InputMistake] = []
    for folder in list_sweep_folders(results):
        name = "/".join(folder.relative_to(results).parts) or folder.resolve().name
        files = [file for file in _list_published_files(folder) if file.resolve() != archive.resolve()]
        refused += [InputMistake(why, file) for file in files if (why := _explain_exclusion(file, results))]
        content |= {f"results/{name}/{file.relative_to(folder).as_posix()}": file for file in files}
        config = read_owner(folder)
        if config and _is_config(config):
            files = _list_required_files(config)
            refused += [InputMistake(why, file) for file in files if (why := _explain_exclusion(file, config.parent))]
            content |= {f"configs/{name}/{os.path.relpath(file, config.parent)}": file for file in files}
            relative_path = os.path.relpath(f"configs/{name}/{config.name}", f"results/{name}")
            content[f"results/{name}/{CLAIM}"] = os.fsencode(f"{relative_path}\n")
        else:
            gone = f"{config}, which it states as its config, is none" if config else "its config does not exist"
            print_message(f"{folder}: {gone}, so its runs cannot be repeated")
    odd = "its name is no UTF-8, or breaks a line; rename it"
    refused += [InputMistake(odd, Path(name)) for name in content if _INVALID_NAME_CHARACTERS.search(name)]
    if refused:
        raise InputError(refused)
    for folder in list_sweep_folders(results):
        parquet_rows.read_rows(row_store.list_units(folder / "rows"))  # raises an error that names damaged files
    content |= {
        "environment/machine.json": _describe_environment(),
        "environment/requirements.txt": _list_requirements(),
    }
    if citation := next(
        (p for p in (_PACKAGE_FOLDER.parent / CITATION_FILE, _PACKAGE_FOLDER / CITATION_FILE) if p.is_file()), None
    ):
        content[CITATION_FILE] = citation
    with atomic_write(archive) as partial:
        _write_archive(partial, content, results.resolve().name, license_text)
    return len(content) + 2  # with the metadata and the checksums


def _list_published_files(folder: Path) -> Iterator[Path]:
    """Yield the files of a sweep's results that are intended for readers."""
    for path in sorted(folder.rglob("*")):
        place = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in place.parts)
        if (path.is_file() or path.is_symlink()) and not hidden and place.parts[0] != "build":
            yield path


def _explain_exclusion(path: Path, folder: Path) -> str:
    """Return why a file is excluded.

    The result is empty if the file lies in the folder after all links are resolved.
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
            return bool(read_assignment_json(path))
    with suppress(InputError):
        return path.suffix.lower() in (".yaml", ".yml") and find_config_kind(read_yaml(path).data) is not None
    return False


def _list_required_files(config: Path) -> list[Path]:
    """Return a config and the files that it names, without running its code."""
    files = {config}
    with suppress(InputError):  # a config of another kind, or an invalid one, is published without what it names
        sweep = load_config(config, imports_code=False)
        plugins = select_plugins(sweep.reports)
        for run in sweep.list_runs():
            scene = run.scene
            files.add(scene.path)
            if scene.path.suffix.lower() == ".json":
                files.add(scene.path.parent / read_assignment_json(scene.path).obj)
            for part in (scene.mesh, *scene.effects):
                if isinstance(part, ConfigModel):  # the configuration of user code is not inspected
                    files |= {value for value in vars(part).values() if isinstance(value, Path)}
            for _, given in scene.plugins.values():  # a plug-in's file is a pair of name and digest
                there = scene.path.parent
                files |= {there / value[0] for value in given.values() if _is_file(value, there)}
            plugins += run.find_plugins()
        files |= {Path(plugin.source_path) for plugin in plugins if _is_local_plugin(plugin)}
    return sorted({Path(os.path.abspath(path)) for path in files})


def _is_file(value: Any, folder: Path) -> bool:
    return is_list(value) and len(value) == 2 and isinstance(value[0], str) and (folder / value[0]).is_file()


def _is_local_plugin(plugin: PluginName) -> bool:
    return plugin.startswith("./") and Path(plugin.source_path).is_file()


def _describe_environment() -> bytes:
    environment = asdict(machine_info.describe_machine()) | {
        "versions": machine_info.collect_versions(),
        "commit": machine_info.read_commit(),
    }
    return (json.dumps(environment, indent=2, sort_keys=True, default=str) + "\n").encode()


def _list_requirements() -> bytes:
    return "".join(sorted({f"{d.metadata['Name']}=={d.version}\n" for d in distributions()}, key=str.lower)).encode()


def _write_archive(path: Path, content: Mapping[str, FileContent], title: str, license_text: str) -> None:
    sums: dict[str, str] = {}
    sizes: dict[str, int] = {}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as packed:

        def put(name: str, data: FileContent) -> None:
            digest, size = hashlib.sha256(), 0
            of_file = isinstance(data, Path)
            info = zipfile.ZipInfo.from_file(data, name, strict_timestamps=False) if of_file else name
            with packed.open(info, "w") as into:
                for chunk in _iterate_chunks(data):
                    digest.update(chunk)
                    into.write(chunk)
                    size += len(chunk)
            sums[name], sizes[name] = digest.hexdigest(), size

        for name, data in sorted(content.items()):
            put(name, data)
        put(CRATE_FILE, (json.dumps(_build_crate_metadata(sums, sizes, title, license_text), indent=2) + "\n").encode())
        packed.writestr(CHECKSUM_FILE, "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items())))


def _iterate_chunks(data: FileContent) -> Iterator[bytes]:
    if isinstance(data, bytes):
        yield data
        return
    with data.open("rb") as file:
        while chunk := file.read(_BUFFER_SIZE):
            yield chunk


def _build_crate_metadata(
    checksums: Mapping[str, str], sizes: Mapping[str, int], title: str, license_text: str
) -> dict[str, Any]:
    """Build the metadata: the data set, its files, and the program that made them."""
    files = [
        {
            "@id": name,
            "@type": "File",
            "name": PurePosixPath(name).name,
            "encodingFormat": _MEDIA_TYPES.get(PurePosixPath(name).suffix)
            or mimetypes.guess_type(name)[0]
            or "text/plain",
            "contentSize": str(sizes[name]),
            "sha256": digest,
        }
        for name, digest in checksums.items()
    ]
    program = {
        "@id": "#springbench",
        "@type": "SoftwareApplication",
        "name": "springbench",
        "softwareVersion": version("springbench"),
        "description": f"at the commit {machine_info.read_commit()}",
    }
    made = {
        "@id": "#runs",
        "@type": "CreateAction",
        "name": "The runs of these sweeps",
        "instrument": {"@id": "#springbench"},
        "object": [{"@id": name} for name in checksums if name.startswith("configs/")],
        "result": [{"@id": name} for name in checksums if name.startswith("results/")],
    }
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": f"springbench results: {title}",
        "description": "Measurements of implicit time stepping of mass-spring systems, with what made them",
        "datePublished": datetime.now(UTC).isoformat(timespec="seconds"),
        "license": license_text or "not stated; request it from the publisher",
        "hasPart": [{"@id": file["@id"]} for file in files],
        "mentions": [{"@id": "#runs"}],
    }
    about = {
        "@id": CRATE_FILE,
        "@type": "CreativeWork",
        "conformsTo": {"@id": "https://w3id.org/ro/crate/1.1"},
        "about": {"@id": "./"},
    }
    return {"@context": "https://w3id.org/ro/crate/1.1/context", "@graph": [about, root, program, made, *files]}
