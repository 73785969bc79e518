"""Ablation unit: the full scene, the scene without each effect, and two more accurate solutions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from harness.base import holding, machine
from harness.base.progress import Display
from harness.base.workers import Tick
from harness.config.load import Sweep
from harness.config.sweep import RunSpec
from harness.experiments.ablation.base import OfEffects, Row
from harness.experiments.ablation.difference import States, difference, rest_length
from harness.experiments.ablation.side_by_side import Contender, cost, motion, seconds, turns
from harness.experiments.ablation.suggest import seen, suggestions
from harness.experiments.ablation.variants import variants
from harness.experiments.core import do_all
from harness.experiments.failure import failure
from harness.experiments.provenance import asked, provenance
from harness.experiments.resume import wanted
from harness.scenes.bind import Scene, build
from harness.simulation.algebraic import stop_rule
from harness.simulation.measure import Settings
from solvers.problem import Solver, StopRule
from solvers.registry import EVERY, SOLVERS, load

_BETTER_ANSWERS = ("solver", "time-step")
"""What is improved in each of the more accurate solutions."""

BETTER = "newton"
"""Solver whose solution determines the distance of the scene's own solver from the minimum."""
CONVERGED = StopRule(200, 1e-8)
"""Its tolerance is far below any difference that an effect makes."""


@dataclass(frozen=True, slots=True)
class Ablation(OfEffects):
    """Run of a scene, in full and without its effects, timed interleaved in one process.

    `pairs` selects variants without each pair of effects, too.
    """

    pairs: bool

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        return f"{self.run.title}: without each effect"

    @property
    def ticks(self) -> int:
        """Number of variants, timed rounds and more accurate solutions."""
        return len(variants(self.run.scene, pairs=self.pairs)) + self.run.rounds + len(_BETTER_ANSWERS)

    def suffix(self) -> str:
        """Return the suffix of the file: `-pairs` with pairs of effects."""
        return "-pairs" if self.pairs else ""

    def measured(self, tick: Tick) -> list[Row]:
        """Measure all variants and return the rows."""
        return _measured(self.run, self.pairs, tick)

    def unanswered(self, status: str, reason: str) -> list[Row]:
        """Build the row of a failed unit: without the full scene no comparison is possible."""
        why = {"kind": "whole", "name": "", "status": status, "reason": reason}
        return [asked(self.run) | provenance() | why]


def run_ablation(
    sweep: Sweep,
    folder: Path,
    display: Display,
    say: Callable[[str], None],
    *,
    pairs: bool,
    again: bool = False,
    changed: bool = False,
    isolated: bool = True,
) -> Path:
    """Execute the ablation of the only run of a scene's sweep, if it is missing.

    The rounds of the run are those of the timing. Where the full scene has no solution, the file has one row.

    Args:
        sweep: sweep with one run.
        folder: folder of the results.
        display: shows progress.
        say: prints a remark.
        pairs: whether to leave out each pair of effects, too.
        again: whether to repeat the ablation.
        changed: whether to repeat it if it was measured by other source code.
        isolated: see `harness.experiments.core.do_all`.

    Returns: the file of rows.

    Raises:
        InputError: the scene or an option is invalid.
    """
    (run,) = sweep.runs()
    run.scene.require_even_steps()
    unit = Ablation(run, folder, pairs)
    folder.mkdir(parents=True, exist_ok=True)
    with holding.alone(folder):
        do_all(wanted([unit], "ablations", say, again=again, changed=changed), display, isolated=isolated)
    return unit.path


def _measured(run: RunSpec, pairs: bool, tick: Tick) -> list[Row]:
    """Measure all variants and build the rows. Errors for the full scene are raised unchanged."""
    settings = Settings(stop_rule(run.iterations, run.tolerance), run.first_guess, run.frames, run.rounds)
    solver: Solver = load(EVERY[run.solver.name])(**run.solver.parameters)
    with machine.pinned_threads(machine.threads(run.threads).number):
        found = turns(variants(run.scene, pairs=pairs), run.size, run.integrator, solver, settings, tick)
        whole = found[0]
        assert whole.scene is not None
        told = [_whole(whole), *(_without(whole, turn) for turn in found[1:])]
        told += _errors(run, whole, settings, tick)
        kinds = {effect.kind for effect in run.scene.effects}
        motion_seen = seen(whole.scene, kinds, whole.positions, whole.velocities)
        told += [
            {"kind": "suggestion", "name": s.effect, "reason": s.evidence} for s in suggestions(motion_seen, kinds)
        ]
    return _shared(run, whole.scene, told)


def _whole(whole: Contender) -> Row:
    return {"kind": "whole", "name": "", "status": "ok", "seconds": seconds(whole)} | _built(whole)


def _without(whole: Contender, turn: Contender) -> Row:
    row: Row = {"kind": "without", "name": turn.variant.name}
    if turn.failure:
        return row | {"status": "impossible", "reason": turn.failure}
    assert whole.scene is not None
    middle, low, high = cost(whole, turn)
    costs = {"seconds": seconds(turn), "cost": middle, "cost_low": low, "cost_high": high}
    apart = difference(whole.scene, (whole.positions, whole.velocities), (turn.positions, turn.velocities))
    return row | {"status": "ok"} | costs | _built(turn) | apart


def _built(turn: Contender) -> Row:
    assert turn.prepared is not None
    facts = turn.prepared.facts
    factor = facts.get("nnz_hessian_factor", facts.get("nnz_factor"))
    counts = {"nnz_system": facts.get("nnz_system"), "nnz_factor": factor}
    return {"bytes": turn.bytes, **{name: None if value is None else int(value) for name, value in counts.items()}}


def _errors(run: RunSpec, whole: Contender, settings: Settings, tick: Tick) -> list[Row]:
    """Measure the error of the full scene's solver, and that of its time step.

    These are the distance from the minima of the steps, and the distance of those from half the time step.
    """
    assert whole.scene is not None
    settings = replace(settings, stop=CONVERGED)
    found: list[Row] = []
    finer: States = (whole.positions, whole.velocities)
    for every, name in enumerate(_BETTER_ANSWERS, start=1):
        row: Row = {"kind": "error", "name": name}
        try:
            scene = build(run.scene.stepped(run.scene.time_step / every), run.size, run.integrator)
            coarser, finer = finer, motion(scene, load(SOLVERS[BETTER])(), settings, every=every)
            found.append(row | {"status": "ok"} | difference(whole.scene, coarser, finer))
        except Exception as error:  # the better solver may fail in any way: then the error is not known
            told = failure(error)
            found += [
                {"kind": "error", "name": n, "status": "unknown", "reason": told["reason"]}
                for n in _BETTER_ANSWERS[every - 1 :]
            ]
            break
        tick(f"error of the {name}")
    return found


def _shared(run: RunSpec, scene: Scene, told: list[Row]) -> list[Row]:
    """Add the columns that all rows share."""
    shared = asked(run) | {
        "vertices": len(scene.mesh.rest),
        "springs": len(scene.springs.edges),
        "frames": run.frames,
        "rounds": run.rounds,
        "extent": scene.mesh.size / rest_length(scene),
    }
    return [shared | provenance() | row for row in told]
