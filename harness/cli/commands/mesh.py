"""Command `springbench mesh`: report on a mesh file, with what is suspicious in it."""

from __future__ import annotations

import json
import logging
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from springbench.harness.cli.shared_options import require_output_file
from springbench.harness.console import get_output_console, print_message, show_activity
from springbench.harness.errors import InputError, InputMistake

if TYPE_CHECKING:
    from springbench.harness.scenes.mesh.file_mesh import FileMesh
    from springbench.harness.scenes.mesh.mesh_checks import MeshSupport

_SCENE_SUFFIXES = (".yaml", ".yml")


def mesh(
    file: Annotated[Path, typer.Argument(help="Mesh file, or scene (YAML) with `mesh: {kind: file, ...}`.")],
    scale: Annotated[float | None, typer.Option(help="Metres per unit of the file.")] = None,
    units: Annotated[str | None, typer.Option(help="Unit of the file, instead of --scale: mm, cm, in, ...")] = None,
    up: Annotated[str | None, typer.Option(help="Axis of the file that points up: y, z, x, -y, -z or -x.")] = None,
    weld: Annotated[float | None, typer.Option(help="Distance [m] up to which vertices become one.")] = None,
    unused: Annotated[str | None, typer.Option(help="Vertices without a cell: keep or drop.")] = None,
    faces: Annotated[str | None, typer.Option(help="Degenerate faces: strict or drop-degenerate.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Picture to write (.png), with the findings marked.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, with all places.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit code 1 if anything is suspicious.")] = False,
) -> None:
    """Report on a mesh file: contents, extent, parts, seams, face and edge faults, possible selections."""
    require_output_file(output, ".png", "--output")
    show_activity("reading the mesh")
    from springbench.harness.scenes.mesh.mesh_report import build_mesh_report

    given = {"scale": scale, "units": units, "up": up, "weld": weld, "unused": unused, "faces": faces}
    source, support = _load_source(file, {key: value for key, value in given.items() if value is not None})
    report = build_mesh_report(source, support)
    if as_json:
        print(json.dumps(report.to_json(), indent=2, allow_nan=False))
    else:
        for line in report.format_lines():
            get_output_console().print(line, markup=False, highlight=False, emoji=False, soft_wrap=True)
    if output:
        from springbench.harness.report.mesh_findings_picture import draw_mesh_findings

        draw_mesh_findings(report, output)
        print_message(f"the picture is {output}")
    raise typer.Exit(1 if strict and report.is_suspicious else 0)


def _load_source(file: Path, options: dict[str, Any]) -> tuple[FileMesh, MeshSupport | None]:
    """Load a mesh file, or that of a scene with its supports.

    Options override the keys of the scene.
    """
    from springbench.harness.scenes.mesh.file_mesh import FileMesh

    if file.suffix.lower() not in _SCENE_SUFFIXES:
        return _validate_source({"path": file} | options), None
    from springbench.harness.config.config_loader import load_scene
    from springbench.harness.scenes.mesh_support import find_mesh_support

    with _silence_log():  # the report contains the warnings about the mesh
        scene = load_scene(file)
        if not isinstance(scene.mesh, FileMesh):
            raise InputError(InputMistake("names no mesh file; expected `mesh: {kind: file, path: ...}`", file))
        replaced = {"scale", "units"} if options.keys() & {"scale", "units"} else set[str]()
        source = _validate_source(scene.mesh.model_dump(exclude_unset=True, exclude=replaced) | options)
        return source, find_mesh_support(scene, source.build_mesh())


def _validate_source(keys: dict[str, Any]) -> FileMesh:
    from pydantic import ValidationError
    from springbench.harness.scenes.mesh.file_mesh import FileMesh

    try:
        return FileMesh.model_validate(keys)
    except ValidationError as error:
        raise InputError([_convert_error(detail) for detail in error.errors()]) from None


def _convert_error(detail: Any) -> InputMistake:
    key = "".join(f"--{part}" for part in detail["loc"][:1])
    return InputMistake(f"{detail['msg']}, got {str(detail['input'])[:40]!r}" if key else detail["msg"], key=key)


@contextmanager
def _silence_log() -> Generator[None]:
    log = logging.getLogger("springbench")
    log.disabled = True
    try:
        yield
    finally:
        log.disabled = False
