"""Can this process draw? VTK segfaults where the system has no OpenGL libraries, so a child process tries first."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache

from harness.base.errors import RunFailed

_TRY = """
from vtkmodules.vtkRenderingCore import vtkRenderWindow
import vtkmodules.vtkRenderingOpenGL2
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(8, 8)
window.Render()
raise SystemExit(not window.SupportsOpenGL())
"""
_SECONDS = 60


@cache
def problem() -> str | None:
    """Why pictures of scenes cannot be drawn here and what to do about it; None where they can.

    Without a display VTK is told to draw through EGL. The answer is found once a process.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
    try:
        child = subprocess.run([sys.executable, "-c", _TRY], capture_output=True, timeout=_SECONDS)
        ended = f"exit code {child.returncode}"
    except subprocess.TimeoutExpired:
        child, ended = None, f"no answer within {_SECONDS} s"
    if child is not None and child.returncode == 0:
        return None
    return (
        f"pictures need OpenGL, and a trial drawing failed ({ended}); on Debian and Ubuntu install it with "
        "`apt-get install libegl1 libgl1-mesa-dri` (no display is needed)"
    )


def require() -> None:
    """Raise RunFailed, with the command that installs what is missing, where OpenGL cannot draw."""
    message = problem()
    if message is not None:
        raise RunFailed(message)
