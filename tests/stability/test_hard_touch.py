"""Every scene of configs/hard-touch by every solver that claims contact of surfaces: no intersection in any frame."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.config.load import load_scene
from harness.scenes.bind import build
from harness.simulation.observe import intersections
from harness.simulation.step import prepare, simulate
from solvers.contact.self_contact import PairContact
from solvers.core.clearing import Blocked
from solvers.methods.lbfgs import Lbfgs
from solvers.problem import Solver, StopRule
from solvers.registry import SOLVERS, load

CASES = {
    path.stem: path for path in sorted((Path(__file__).resolve().parents[2] / "configs/hard-touch").glob("*.yaml"))
}
SOLVE: dict[str, Solver] = {name: load(SOLVERS[name])() for name in ("newton", "newton-cg", "pncg", "lbfgs", "hybrid")}
SOLVE["lbfgs float32"] = Lbfgs(precision="float32")
QUICK = {"edges-parallel", "vertex-on-face", "needles", "ropes-parallel"}
IMPOSSIBLE = {"slit-closes": "obstacles leave no room"}
FEW = {"lbfgs": 4, "lbfgs float32": 4}
"""Frames, where iterations are many."""


@pytest.mark.parametrize("name", SOLVE)
@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=() if case in QUICK else pytest.mark.long, id=case) for case in CASES]
)
def test_nothing_passes_through_anything(case: str, name: str):
    spec = load_scene(CASES[case])
    made, touched = build(spec, spec.default_size or 6), 0
    rule, frames = StopRule(60, 1e-4), FEW.get(name, spec.frames)
    run = simulate(made, prepare(made, SOLVE[name]), rule, first_guess="current", frames=frames)
    if case in IMPOSSIBLE:
        with pytest.raises(Blocked, match=IMPOSSIBLE[case]):
            list(run)
        return
    for step in run:
        assert intersections(made, step.positions, made.time(step.index)) == 0
        energies = [energy for energy in step.problem.energies if isinstance(energy, PairContact)]
        assert not any(energy.closed(step.positions) for energy in energies)
        touched += sum(len(energy.blocks(step.positions).vertices) for energy in energies)
    assert touched or frames < 10
