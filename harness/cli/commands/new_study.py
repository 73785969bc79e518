"""Command `springbench new`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from springbench.harness.console import print_message
from springbench.harness.errors import InputError, InputMistake


def new_study(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to create; its name is the study's.")],
) -> None:
    """Write a first study: scene, sweep, solver, performance test and README."""
    from springbench.harness.config.json_schema import build_json_schema
    from springbench.harness.config.shipped_configs import list_template_files

    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InputError(InputMistake("exists and is not an empty folder; give another name", folder))
    folder.mkdir(parents=True, exist_ok=True)
    files = {path.name: path.read_text(encoding="utf-8") for path in list_template_files()}
    files["README.md"] = files["README.md"].replace("STUDY", folder.resolve().name)
    files["schema.json"] = json.dumps(build_json_schema(), indent=2) + "\n"
    for name, text in files.items():
        (folder / name).write_text(text, encoding="utf-8")
    print_message(f"{folder} has {', '.join(sorted(files))}. Next:\n  cd {folder}\n  springbench run compare.yaml")
