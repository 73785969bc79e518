"""Runs of 100,000 steps (`pytest -m long`): nothing drifts away, and what should come to rest has.

Three scenes by local-global, L-BFGS, Newton's method and the hybrid: 5 to 60 seconds of one core each.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.time_loop import build_initial_state, prepare, simulate_scene
from springbench.solvers.methods.local_global.compiled_local_global import CompiledLocalGlobal
from springbench.solvers.methods.newton.hybrid_newton import HybridNewton
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.methods.quasi_newton.lbfgs import Lbfgs
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Solver, StopRule

pytestmark = pytest.mark.long

SCENES = Path(__file__).resolve().parents[2] / "configs" / "hard-long"
STOP = StopRule(50, 1e-6)


def hangs(made: Scene, now: Motion) -> None:
    # Drag-free implicit Euler has damped every swing to what the tolerance leaves of a step.
    assert np.abs(now.velocity).max() <= 1e-8 * made.mesh.bounding_box_diagonal / made.system.time_step


def conserves_momentum(made: Scene, now: Motion) -> None:
    mass = made.system.mass[:, None]
    centre = (mass * now.positions).sum(axis=0) / mass.sum()
    begun = (mass * build_initial_state(made).motion.positions).sum(axis=0) / mass.sum()
    # Each step's round-off, 1e-16 of the size, adds to the centre's velocity and so, as t^2 at worst, to its place.
    assert np.abs(centre - begun).max() <= 1e-6 * made.mesh.bounding_box_diagonal


def stays_near_its_hand(made: Scene, now: Motion) -> None:
    # The driving circle is 0.2 m wide; a chain of 1 m stretches by less than its own length under 1 N.
    assert np.abs(now.positions).max() <= 3.0


CHECKS: dict[str, Callable[[Scene, Motion], None]] = {
    "long-hanging-cloth": hangs,
    "long-spinning-net": conserves_momentum,
    "long-driven-chain": stays_near_its_hand,
}


@pytest.mark.parametrize(
    "solver", [CompiledLocalGlobal(), Lbfgs(), NewtonSolver(), HybridNewton()], ids=lambda solver: type(solver).__name__
)
@pytest.mark.parametrize("name", CHECKS)
def test_a_hundred_thousand_steps_drift_nowhere(name: str, solver: Solver):
    spec = load_scene(SCENES / f"{name}.yaml")
    assert spec.frames == 100_000
    made = build_scene(spec, spec.default_size or 0)
    now = build_initial_state(made).motion
    for step in simulate_scene(made, prepare(made, solver), STOP, initial_guess="previous", frames=spec.frames):
        now = step.state.motion
        assert np.isfinite(now.positions).all(), f"frame {step.index}"
    CHECKS[name](made, now)
