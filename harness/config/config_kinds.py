"""Kinds of configs, and their reader: each kind is recognised by a key, and a command reads it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from springbench.harness.errors import InputError, InputMistake
from springbench.harness.schema.config_document import IMPORT_USER_CODE, ConfigDocument, UserCodePolicy
from springbench.harness.schema.yaml_loader import read_yaml


class ConfigKind(NamedTuple):
    """A kind of config: its name, the keys of which it has one, and the commands that read it."""

    name: str
    keys: tuple[str, ...]
    usage: str

    @property
    def description(self) -> str:
        """Name and keys."""
        return f"{self.name} (with {' or '.join(f'`{key}`' for key in self.keys)})"


_RUN_USAGE = "`springbench run`, or `springbench regress` with --baseline REVISION"
SCENE = ConfigKind("a scene", ("mesh",), _RUN_USAGE)
SWEEP = ConfigKind("a sweep", ("scenes",), _RUN_USAGE)
ACCURACY = ConfigKind("an accuracy config", ("curves", "work"), "`springbench accuracy`")
GATES = ConfigKind("a gates file", ("gates",), "`springbench regress` without --baseline")
CONFIG_KINDS = (ACCURACY, GATES, SWEEP, SCENE)
"""All kinds; an accuracy config has the key of a sweep, too, so it comes first."""


def find_config_kind(keys: Iterable[str]) -> ConfigKind | None:
    """Find the kind of a config by its top-level keys; None if it has the key of no kind."""
    present = set(keys)
    return next((kind for kind in CONFIG_KINDS if present & {*kind.keys}), None)


def is_assignment_file(path: Path) -> bool:
    """Return whether a file is a scene of the assignment, which is JSON."""
    return path.suffix.lower() == ".json"


def read_config(
    path: Path, *kinds: ConfigKind, policy: UserCodePolicy = IMPORT_USER_CODE
) -> tuple[ConfigKind, ConfigDocument]:
    """Read a config of one of the given kinds.

    Args:
        path: YAML file; or JSON file of an assignment, whose document is empty.
        kinds: expected kinds.
        policy: policy for code that the config names.
    Returns: its kind, and its document.
    Raises:
        InputError: if it cannot be read, or is of another kind.
    """
    is_assignment = is_assignment_file(path)
    document = ConfigDocument(path, {}) if is_assignment else read_yaml(path)
    document.user_code = policy
    kind = SCENE if is_assignment else find_config_kind(document.data)
    expected = " or ".join(one.description for one in kinds)
    if kind is None:
        raise InputError(InputMistake(f"is no config: expected {expected}", path))
    if kind in kinds:
        return kind, document
    raise InputError(InputMistake(f"is {kind.description}, for {kind.usage}; expected {expected}", path))
