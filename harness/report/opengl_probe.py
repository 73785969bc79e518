"""Check whether this process can draw with OpenGL.

VTK crashes with a segmentation fault if the system has no OpenGL libraries, so a child process tries first. On Linux
without a display, a success is stored for the user until system packages, VTK or environment variables change.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from springbench.harness.atomic_files import get_user_cache_dir
from springbench.harness.errors import RunFailed
from springbench.harness.execution.optional_parts import PICTURES

_PROBE_SCRIPT = """
from vtkmodules.vtkRenderingCore import vtkRenderWindow
import vtkmodules.vtkRenderingOpenGL2
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(8, 8)
window.Render()
raise SystemExit(not window.SupportsOpenGL())
"""
_PROBE_TIMEOUT = 60
"""Timeout of the probe [s]."""

_SYSTEM_FILES = ("/etc/ld.so.cache", "/var/lib/dpkg/status", "/var/lib/rpm")
"""Files that change with the installed libraries."""

_PROBES = list["subprocess.Popen[bytes]"]()
"""The child process of the probe, if it was started."""


def start_opengl_probe() -> None:
    """Start the probe in the background."""
    if _PROBES or find_opengl_problem.cache_info().currsize or not PICTURES.is_installed():
        return
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    if (marker := _find_marker()) and marker.exists():
        return
    nowhere = subprocess.DEVNULL
    _PROBES.append(subprocess.Popen([sys.executable, "-c", _PROBE_SCRIPT], stdout=nowhere, stderr=nowhere))


@cache
def find_opengl_problem() -> str | None:
    """Return why scenes cannot be drawn and how to fix it; None if drawing works.

    Without a display VTK is configured to draw through EGL. The result is computed once per process.
    """
    if not PICTURES.is_installed():
        return PICTURES.describe_absence()
    start_opengl_probe()
    if not _PROBES:
        return None
    child = _PROBES.pop()
    try:
        ended = f"exit code {child.wait(_PROBE_TIMEOUT)}"
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
        ended = f"no answer within {_PROBE_TIMEOUT} s"
    if child.returncode == 0:
        if marker := _find_marker():
            with suppress(OSError):
                marker.parent.mkdir(parents=True, exist_ok=True)
                marker.touch()
        return None
    return (
        f"pictures need OpenGL, and a trial drawing failed ({ended}); on Debian and Ubuntu install it with "
        "`apt-get install libegl1 libgl1-mesa-dri` (no display is needed)"
    )


def _find_marker() -> Path | None:
    """Return the file that exists if a probe has succeeded with these libraries.

    It is None with a display, and on other systems than Linux.
    """
    if sys.platform != "linux" or os.environ.get("DISPLAY"):
        return None
    found = [os.stat(name) for name in _SYSTEM_FILES if os.path.exists(name)]
    variables = {
        name: value for name, value in os.environ.items() if name.startswith(("LD_", "VTK_", "EGL", "LIBGL", "MESA"))
    }
    state = [(one.st_mtime_ns, one.st_size) for one in found], sorted(variables.items()), version("vtk"), sys.prefix
    return get_user_cache_dir("opengl") / sha256(repr((state, _PROBE_SCRIPT)).encode()).hexdigest()[:32]


def require_opengl() -> None:
    """Raise RunFailed, with the command that installs what is missing, if OpenGL cannot draw."""
    message = find_opengl_problem()
    if message is not None:
        raise RunFailed(message)
    os.environ.setdefault("ALLOW_PLOTTING", "true")  # PyVista's own check opens a window once more
