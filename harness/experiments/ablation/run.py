"""Runs an ablation: the whole scene, without each effect, and with better answers; leaves its rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.base import machine, rows
from harness.config.load import Sweep
from harness.config.sweep import RunSpec
from harness.experiments.ablation.cases import cases
from harness.experiments.ablation.difference import Motion, difference, rest_length
from harness.experiments.ablation.rows import SCHEMA
from harness.experiments.ablation.suggest import seen, suggestions
from harness.experiments.ablation.turns import Turn, cost, motion, seconds, turns
from harness.experiments.columns import asked, provenance
from harness.experiments.failure import failure
from harness.scenes.bind import Scene, build
from harness.simulation.measure import Settings
from solvers.problem import Solver, StopRule
from solvers.registry import EVERY, SOLVERS, load

Row = dict[str, Any]

BETTER = "newton"
"""Whose answer tells how far the scene's own solver is from the minimum."""
CONVERGED = StopRule(200, 1e-8)
"""Far below any difference that an effect makes."""


def ablate(sweep: Sweep, folder: Path, *, pairs: bool, tick: Callable[[str], None]) -> Path:
    """Ablate the one run of a scene's sweep, whose rounds are those of the timing; returns the file of rows.

    Raises InputError for what the user can mend, Unsupported where the solver cannot do the whole scene.
    """
    (run,) = sweep.runs()
    run.scene.require_even_steps()
    settings = Settings(StopRule(run.iterations, run.tolerance), run.first_guess, run.frames, run.rounds)
    solver: Solver = load(EVERY[run.solver.name])(**run.solver.parameters)
    with machine.pinned_threads(machine.threads(run.threads).number):
        found = turns(cases(run.scene, pairs=pairs), run.size, run.integrator, solver, settings, tick)
        whole = found[0]
        assert whole.scene is not None
        told = [_whole(whole), *(_without(whole, turn) for turn in found[1:])]
        told += _errors(run, whole, settings, tick)
        kinds = {effect.kind for effect in run.scene.effects}
        motion_seen = seen(whole.scene, kinds, whole.positions, whole.velocities)
        told += [
            {"kind": "suggestion", "name": s.effect, "reason": s.evidence} for s in suggestions(motion_seen, kinds)
        ]
    path = folder / "ablation" / f"{run.label(machine.describe().id)}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    rows.write(path, _shared(run, whole.scene, told), SCHEMA)
    return path


def _whole(whole: Turn) -> Row:
    return {"kind": "whole", "name": "", "status": "ok", "seconds": seconds(whole)} | _built(whole)


def _without(whole: Turn, turn: Turn) -> Row:
    row: Row = {"kind": "without", "name": turn.case.name}
    if turn.failure:
        return row | {"status": "impossible", "reason": turn.failure}
    assert whole.scene is not None
    middle, low, high = cost(whole, turn)
    costs = {"seconds": seconds(turn), "cost": middle, "cost_low": low, "cost_high": high}
    apart = difference(whole.scene, (whole.positions, whole.velocities), (turn.positions, turn.velocities))
    return row | {"status": "ok"} | costs | _built(turn) | apart


def _built(turn: Turn) -> Row:
    assert turn.prepared is not None
    facts = turn.prepared.facts
    factor = facts.get("nnz_hessian_factor", facts.get("nnz_factor"))
    counts = {"nnz_system": facts.get("nnz_system"), "nnz_factor": factor}
    return {"bytes": turn.bytes, **{name: None if value is None else int(value) for name, value in counts.items()}}


def _errors(run: RunSpec, whole: Turn, settings: Settings, tick: Callable[[str], None]) -> list[Row]:
    """How far the whole scene is from the minima of its steps, and those from the minima of half the time step."""
    assert whole.scene is not None
    settings = replace(settings, stop=CONVERGED)
    names: Sequence[str] = ("solver", "time-step")
    found: list[Row] = []
    finer: Motion = (whole.positions, whole.velocities)
    for every, name in enumerate(names, start=1):
        row: Row = {"kind": "error", "name": name}
        try:
            scene = build(run.scene.stepped(run.scene.time_step / every), run.size, run.integrator)
            coarser, finer = finer, motion(scene, load(SOLVERS[BETTER])(), settings, every=every)
            found.append(row | {"status": "ok"} | difference(whole.scene, coarser, finer))
        except Exception as error:  # the better solver may fail in any way: then the error is not known
            told = failure(error)
            found += [
                {"kind": "error", "name": n, "status": "unknown", "reason": told["reason"]} for n in names[every - 1 :]
            ]
            break
        tick(f"error of the {name}")
    return found


def _shared(run: RunSpec, scene: Scene, told: list[Row]) -> list[Row]:
    """The rows with the columns that are the same in all of them."""
    shared = asked(run) | {
        "vertices": len(scene.mesh.rest),
        "springs": len(scene.springs.edges),
        "frames": run.frames,
        "rounds": run.rounds,
        "extent": scene.mesh.size / rest_length(scene),
    }
    return [shared | provenance() | row for row in told]
