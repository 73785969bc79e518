"""Hard cases on a device: what a method's first steps are there, compared with the processor's.

    NUMBA_ENABLE_CUDASIM=1 .venv/bin/python -m pytest -q -n 0 -s -m long tests/cuda/test_hard.py

A case is right on a device where its positions are near to the processor's: by the kernels' precision, or within some
times what the processor's own move by where its start is changed by round-off. In many hard cases that is much: springs
that begin without a length point where round-off says. In float32 a minimiser may go elsewhere, if as far down.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state, build_problem, prepare, simulate_scene
from springbench.solvers.methods.newton.newton_cg import NewtonCG
from springbench.solvers.methods.position_based.xpbd import Xpbd, XpbdSmallSteps
from springbench.solvers.methods.vertex_block.vbd import VertexBlockDescent
from springbench.solvers.model.integrators import Motion
from springbench.solvers.model.step_problem import Positions, StopRule, Unsupported
from springbench.solvers.objective.fixed_objective import FixedObjective
from springbench.solvers.objective.step_objective import StepObjective

METHODS: dict[str, Callable[..., Any]] = {
    "vbd": VertexBlockDescent,
    "newton-cg": lambda **on: NewtonCG(preconditioner="schwarz", **on),
    "xpbd": Xpbd,
    "xpbd-small-steps": XpbdSmallSteps,
}

FRAMES, STOP = 2, StopRule(4)
Precision = Literal["float64", "float32"]
ROUND_OFF: dict[Precision, tuple[float, float]] = {"float64": (4e-16, 1e-10), "float32": (1e-7, 1e-5)}
"""By precision: what round-off changes at the start, in parts of the springs' mean length and, in float64, of the
largest coordinate; and how near positions are, in parts of that length and of how far vertices moved."""

TIMES = 100.0
"""So many times what changes of the start make: a vertex is moved by dozens of springs, each of which rounds."""

LESS = 0.01
"""Of the processor's fall of the objective, what a step in float32 may fall by less where it leads elsewhere: where
stiffnesses lie far apart, conjugate gradients in float32 end elsewhere, and as far down."""

Frames = NDArray[np.float64]


class Outcome(NamedTuple):
    """word: right, refused or wrong; why, of all but the first; over: of what it is away from the processor,
    over what it may be."""

    word: Literal["right", "refused", "wrong"]
    why: str = ""
    over: float = 0.0


def outcome(made: Scene, method: str, precision: Precision) -> Outcome:
    """What becomes of a scene."""
    solver = METHODS[method]
    try:
        found = simulate_steps(made, solver(device="cuda", precision=precision))
    except Unsupported as error:
        return Outcome(*_classify_refusal(str(error), made, solver))
    expected, begun = simulate_steps(made, solver()), build_initial_state(made).motion.positions
    if not np.isfinite(found).all():
        return Outcome("wrong" if np.isfinite(expected).all() else "right", "not finite")
    length = float(made.all_springs.rest_length.mean()) if len(made.all_springs.rest_length) else 1.0
    part, near = ROUND_OFF[precision]
    rounded = part * (length + (np.abs(begun).max() if precision == "float64" else 0.0))
    may = near * (length + np.abs(expected - begun).max()) + rounded
    away = np.abs(found - expected).max()
    for seed in range(3):
        if away <= may:
            break
        changes = rounded * np.random.default_rng(seed).uniform(-1.0, 1.0, (2, *begun.shape))
        may = max(may, TIMES * np.abs(simulate_steps(made, solver(), changes) - expected).max())
    why = f"{away:.1e} m from the processor"
    if away > may and precision == "float32" and solver().is_minimiser:
        part = _fall(made, found[0]) / _fall(made, expected[0])
        away, why = may * (1.0 - part) / LESS, f"{why}, its first step falling by {part:.4f} of what that one's does"
    return Outcome("right" if away <= may else "wrong", why, float(away / may))


def simulate_steps(made: Scene, solver: Any, changes: Frames | tuple[float, float] = (0.0, 0.0)) -> Frames:
    """Where the first steps end, (frames, n, 3) [m]. changes (2, n, 3) [m]: of the start's positions, and of what its
    velocities move in a step."""
    prepared = prepare(made, solver)
    state = build_initial_state(made)
    p, v = state.motion
    state = replace(state, motion=Motion(p + changes[0], v + changes[1] / made.system.time_step))
    run = simulate_scene(made, prepared, STOP, initial_guess="previous", frames=FRAMES, initial_state=state)
    return np.array([step.positions for step in run])


def _fall(made: Scene, p: Positions) -> float:
    """What the objective of the first step falls by to p [J]."""
    stated = build_problem(made, build_initial_state(made), "previous")
    return -StepObjective(FixedObjective(made.system), stated).objective_change(p, stated.initial_guess)[0]


def _classify_refusal(why: str, made: Scene, solver: Any) -> tuple[Literal["refused", "wrong"], str]:
    """Because of what a device does not take, or as the processor does."""
    if "device" in why:
        return "refused", why
    try:
        prepare(made, solver())
    except Unsupported as error:
        return ("refused" if str(error) == why else "wrong"), why
    return "wrong", why
