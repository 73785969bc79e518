"""Import of the modules that draw pictures, in the process that draws them."""

from __future__ import annotations

from importlib import import_module

from springbench.harness.execution.progress_events import ignore_progress
from springbench.harness.execution.timing_lock import lock_timing_shared
from springbench.harness.report import opengl_probe

_CHART_MODULES = (
    "springbench.harness.report.sweep_pictures",
    "springbench.harness.report.timing_plot",
)
_SCENE_MODULES = (
    "pyvista",
    "pyvista.plotting",
    "springbench.harness.report.run_picture",
    "springbench.harness.recording.recording_reader",
)


def preload_drawing() -> None:
    """Import what draws the pictures of a sweep, no module while a run is timed."""
    with lock_timing_shared(ignore_progress):
        opengl_probe.start_opengl_probe()
        import_module("matplotlib.figure")
        problem = opengl_probe.find_opengl_problem()
    _import_untimed(_CHART_MODULES)
    if problem is None:
        _import_untimed(_SCENE_MODULES)


def preload_preview() -> None:
    """Import the modules that draw the preview of a scene."""
    opengl_probe.start_opengl_probe()
    import_module("springbench.harness.report.scene_preview")


def _import_untimed(modules: tuple[str, ...]) -> None:
    for module in modules:
        with lock_timing_shared(ignore_progress):
            import_module(module)
