"""Verification status of a finished run: the result of the independent reference implementation.

The result depends on the scene and not on the solver. It is therefore computed once for all runs of a scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.scenes.scene_builder import build_scene
from springbench.harness.verification.verify_scene import MISMATCH, verify_terms
from springbench.solvers.plugins.plugin_discovery import PluginName

SELF_CHECK_ONLY = "single opinion: the integrator comes from outside, and its formula is written once"


@dataclass(frozen=True, slots=True)
class _FormulasKey:
    """Cache key: a run's scene and other settings that determine its formulas."""

    key: tuple[str | int, ...]
    run: RunSpec = field(compare=False)


def build_verification_columns(run: RunSpec) -> dict[str, str]:
    """Return the columns `status`, `second_opinion` and `reason` of a finished run that is verified.

    Columns that do not apply are left out.
    """
    if isinstance(run.integrator, PluginName):
        return {"status": "ok", "second_opinion": SELF_CHECK_ONLY}
    said = verify_formulas(_FormulasKey((run.scene.scene_digest, run.size, run.integrator), run))
    if said.startswith(MISMATCH):
        return {"status": "disputed", "second_opinion": said, "reason": f"the second opinion {said}"}
    return {"status": "ok", "second_opinion": said}


@lru_cache(maxsize=32)
def verify_formulas(key: _FormulasKey) -> str:
    """Return the verification result for a run's scene, at its size and with its integrator."""
    run = key.run
    return verify_terms(run.scene, build_scene(run.scene, run.size, run.integrator), run.integrator)
