"""Text of the JSON Schema of configs, cached for the user by the state of all sources.

Building it imports every solver, mesh and effect, which takes a second or more.
"""

from __future__ import annotations

import json
from contextlib import suppress
from importlib.metadata import version

from springbench.harness.atomic_files import WriteError, atomic_write, user_cache_dir
from springbench.solvers.jit import source_digest

SCHEMA_LIBRARY = "pydantic"
"""The library that derives the schema from the models."""


def read_config_schema() -> str:
    """Return the JSON Schema of all configs as text, from the cache if no source has changed since it was built."""
    path = user_cache_dir("schema") / f"{source_digest.stamp_sources(version(SCHEMA_LIBRARY))[:16]}.json"
    with suppress(OSError, UnicodeDecodeError):
        return path.read_text(encoding="utf-8")
    from springbench.harness.config.json_schema import build_json_schema

    text = json.dumps(build_json_schema(), indent=2)
    with suppress(OSError, WriteError):
        path.parent.mkdir(parents=True, exist_ok=True)
        for older in path.parent.glob("*.json"):
            older.unlink(missing_ok=True)
        with atomic_write(path) as partial:
            partial.write_text(text, encoding="utf-8")
    return text
