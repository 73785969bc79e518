"""Optional parts of an installation: recordings (Rerun), and pictures of scenes (PyVista and VTK).

Each is an extra of the package and takes half a gigabyte. Everything else works without them.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple


class OptionalPart(NamedTuple):
    """A part of the program that needs large libraries.

    Attributes:
        extra: extra of the package that installs the libraries.
        purpose: what the libraries are for.
        libraries: their names in messages.
        modules: their top-level modules.
    """

    extra: str
    purpose: str
    libraries: str
    modules: tuple[str, ...]

    def is_installed(self) -> bool:
        """Return whether all modules are found; nothing is imported."""
        return all(map(_is_found, self.modules))

    def describe_absence(self) -> str:
        """Return what is missing, and the command that installs it."""
        verb = "need" if self.purpose.split()[0].endswith("s") else "needs"
        command = f'pip install "springbench[{self.extra}]"'
        return f"{self.purpose} {verb} {self.libraries}, which this installation lacks; to have it: {command}"


RECORDINGS = OptionalPart("record", "recordings", "Rerun", ("rerun", "rerun_bindings", "rerun_cli"))
PICTURES = OptionalPart("pictures", "pictures of scenes", "PyVista and VTK", ("pyvista", "vtkmodules"))
OPTIONAL_PARTS = (RECORDINGS, PICTURES)
NOTEBOOKS = OptionalPart("notebook", "the viewer in a notebook", "rerun-notebook", ("rerun_notebook", "rerun"))
"""Not part of the complete installation, because only notebooks use it."""


def find_part(error: ModuleNotFoundError) -> OptionalPart | None:
    """Return the missing part that caused an import error; None for any other module."""
    module = (error.name or "").partition(".")[0]
    return next((part for part in OPTIONAL_PARTS if module in part.modules and not part.is_installed()), None)


def _is_found(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:
        return False
