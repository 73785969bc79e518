"""Shipped scenes and configs, found by name: `quickstart`, `hanging-cloth`, `hard/geometry-line`.

The files are data of the package. A name is the path of a file in the folder `configs`, without `.yaml`. A scene in
the folder `scenes` can also be named without that folder.
"""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache
from pathlib import Path

from springbench.harness.errors import InputError, InputMistake

SHIPPED_FOLDER = Path(__file__).parents[2] / "configs"
"""Folder of the shipped configs, in a checkout and in a wheel."""
SCENE_FOLDER = "scenes"
"""Subfolder of the scenes that have a name without a folder."""
_TEMPLATE_FOLDER = "templates"


@cache
def list_shipped_configs() -> dict[str, Path]:
    """List the files of the shipped configs by their names."""
    files = sorted(SHIPPED_FOLDER.rglob("*.yaml"))
    names = {path.relative_to(SHIPPED_FOLDER).with_suffix("").as_posix(): path for path in files}
    return {name: path for name, path in names.items() if not name.startswith(f"{_TEMPLATE_FOLDER}/")}


def list_template_files() -> list[Path]:
    """List the template files of a new study."""
    return sorted(path for path in (SHIPPED_FOLDER / _TEMPLATE_FOLDER / "new-study").iterdir() if path.is_file())


def find_shipped_scene(name: str) -> Path | None:
    """Find a shipped scene by its name, with or without the folder; None if missing."""
    shipped = list_shipped_configs()
    return shipped.get(f"{SCENE_FOLDER}/{name}") or (shipped.get(name) if "/" in name else None)


def resolve_scene_path(name: str, folder: Path) -> Path:
    """Return the path of a config's scene: a file, else a shipped scene.

    Args:
        name: path of a file, relative to the folder; or name of a shipped scene.
        folder: folder of the config.

    Returns:
        The path, which does not exist for a name that is neither.
    """
    path = folder / name
    return path if path.is_file() else find_shipped_scene(name) or path


def suggest_shipped_scene(name: str) -> str:
    """Suggest a shipped scene with a name close to a missing one; empty if none."""
    near = get_close_matches(name, _list_short_names(), n=1)
    return f", and no shipped scene of this name; did you mean {near[0]!r}?" if near else ""


def locate_config(name: str | Path) -> Path:
    """Return the path of a config, given by a path or a shipped name.

    Args:
        name: path of a file; or name of a shipped config, if there is no such file.

    Raises:
        InputError: for a name without a suffix that is neither.
    """
    path = Path(name)
    if path.suffix or path.is_file() or path.is_absolute() or ".." in path.parts or not path.parts:
        return path
    found = list_shipped_configs().get(path.as_posix()) or find_shipped_scene(path.as_posix())
    if found is None and path.exists():  # a folder, which the reader of configs reports
        return path
    if found is None:
        near = get_close_matches(path.as_posix(), _list_short_names(), n=1)
        listed = "`springbench list --shipped` lists these" + (f"; did you mean {near[0]!r}?" if near else "")
        raise InputError(InputMistake(f"is neither a file nor the name of a shipped config; {listed}", path))
    return found


def get_config_name(path: Path) -> str:
    """Return the shortest name of a shipped config, or the path of another config."""
    if not path.is_relative_to(SHIPPED_FOLDER):
        return str(path)
    name = path.relative_to(SHIPPED_FOLDER).with_suffix("").as_posix()
    short = name.removeprefix(f"{SCENE_FOLDER}/")
    return short if locate_config(short) == path else name


def _list_short_names() -> list[str]:
    return [name.removeprefix(f"{SCENE_FOLDER}/") for name in list_shipped_configs()]
