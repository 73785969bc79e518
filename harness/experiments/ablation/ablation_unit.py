"""Ablation unit: the full scene, the scene without each effect, and two more accurate solutions."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from springbench.harness.config.config_loader import SweepPlan
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.execution import folder_locks, machine_info
from springbench.harness.execution.isolated_worker import ProgressCallback
from springbench.harness.execution.progress_display import ProgressDisplay
from springbench.harness.experiments.ablation.effect_unit import EffectUnit, ResultRow
from springbench.harness.experiments.ablation.interleaved_variants import (
    VariantRun,
    compute_cost,
    compute_step_seconds,
    simulate_motion,
    time_interleaved,
)
from springbench.harness.experiments.ablation.motion_difference import (
    MotionStates,
    compute_mean_rest_length,
    compute_motion_difference,
)
from springbench.harness.experiments.ablation.scene_variants import build_variants
from springbench.harness.experiments.completion_status import select_missing_units
from springbench.harness.experiments.experiment_units import execute_units
from springbench.harness.experiments.failure_columns import build_failure_columns
from springbench.harness.experiments.provenance import build_provenance_columns, build_specification_columns
from springbench.harness.scenes.effects.effect_interface import ObservedMotion
from springbench.harness.scenes.effects.effect_table import EFFECT_CLASSES, EFFECT_TABLE
from springbench.harness.scenes.scene_builder import Scene, build_scene
from springbench.harness.simulation.auto_tolerance import build_stop_rule
from springbench.harness.simulation.timing_pass import SteppingSettings
from springbench.solvers.model.step_problem import Solver, StopRule
from springbench.solvers.registry import SOLVER_TABLE, SOLVERS, load_target

_REFERENCE_KINDS = ("solver", "time-step")
"""What is improved in each of the more accurate solutions."""

REFERENCE_SOLVER = "newton"
"""Solver whose solution determines the distance of the scene's own solver from the minimum."""
CONVERGED_STOP_RULE = StopRule(200, 1e-8)
"""Stop rule of the reference solver; its tolerance is far below any difference that an effect makes."""


@dataclass(frozen=True, slots=True)
class AblationUnit(EffectUnit):
    """Run of a scene, in full and without its effects, timed interleaved in one process.

    `with_pairs` selects variants without each pair of effects, too.
    """

    with_pairs: bool

    @property
    def title(self) -> str:
        """Title of the unit, for messages."""
        return f"{self.run.title}: without each effect"

    @property
    def num_progress_steps(self) -> int:
        """Number of variants, timed rounds and more accurate solutions."""
        return len(build_variants(self.run.scene, with_pairs=self.with_pairs)) + self.run.rounds + len(_REFERENCE_KINDS)

    def file_suffix(self) -> str:
        """Return the suffix of the file: `-pairs` with pairs of effects."""
        return "-pairs" if self.with_pairs else ""

    def measure_rows(self, tick: ProgressCallback) -> list[ResultRow]:
        """Measure all variants and return the rows."""
        return _measure_ablation(self.run, self.with_pairs, tick)

    def build_failure_rows(self, status: str, reason: str) -> list[ResultRow]:
        """Build the row of a failed unit: without the full scene no comparison is possible.

        Args:
            status: kind of failure, such as `unsupported`.
            reason: cause of the failure, as a sentence.
        """
        why = {"kind": "full-scene", "name": "", "status": status, "reason": reason}
        return [build_specification_columns(self.run) | build_provenance_columns() | why]


def run_ablation(
    sweep: SweepPlan,
    folder: Path,
    display: ProgressDisplay,
    print_message: Callable[[str], None],
    *,
    with_pairs: bool,
    rerun: bool = False,
    rerun_stale: bool = False,
    isolated: bool = True,
) -> Path:
    """Execute the ablation of the only run of a scene's sweep, if it is missing.

    Every variant is timed in as many rounds as the run has. Where the full scene has no solution, the file has one row.

    Args:
        sweep: sweep with one run.
        folder: folder of the results.
        display: shows progress.
        print_message: prints a remark.
        with_pairs: whether to leave out each pair of effects, too.
        rerun: whether to repeat the ablation.
        rerun_stale: whether to repeat it if it was measured by other source code.
        isolated: whether to use worker processes; otherwise units run here, without limits.

    Returns:
        The file of rows.

    Raises:
        InputError: the scene or an option is invalid.
    """
    (run,) = sweep.list_runs()
    run.scene.require_fixed_time_step()
    unit = AblationUnit(run, folder, with_pairs)
    folder.mkdir(parents=True, exist_ok=True)
    with folder_locks.lock_folder_exclusive(folder):
        execute_units(
            select_missing_units([unit], "ablations", print_message, rerun=rerun, rerun_stale=rerun_stale),
            display,
            isolated=isolated,
        )
    return unit.rows_path


def _measure_ablation(run: RunSpec, with_pairs: bool, tick: ProgressCallback) -> list[ResultRow]:
    """Measure all variants and build the rows. Errors for the full scene are raised unchanged."""
    settings = SteppingSettings(
        build_stop_rule(run.max_iterations, run.rtol), run.initial_guess, run.frames, run.rounds
    )
    solver: Solver = load_target(SOLVER_TABLE[run.solver.name])(**run.solver.parameters)
    with machine_info.limit_threads(machine_info.choose_threads(run.threads).count):
        found = time_interleaved(
            build_variants(run.scene, with_pairs=with_pairs), run.size, run.integrator, solver, settings, tick
        )
        whole = found[0]
        assert whole.scene is not None
        rows = [_build_full_row(whole), *(_build_variant_row(whole, turn) for turn in found[1:])]
        rows += _measure_reference_errors(run, whole, settings, tick)
        kinds = {effect.kind for effect in run.scene.effects}
        motion_seen = build_evidence(whole.scene, kinds, whole.positions, whole.velocities)
        rows += [
            {"kind": "suggestion", "name": s.effect_kind, "reason": s.evidence}
            for s in suggest_effects(motion_seen, kinds)
        ]
    return _add_shared_columns(run, whole.scene, rows)


def _build_full_row(full: VariantRun) -> ResultRow:
    return {
        "kind": "full-scene",
        "name": "",
        "status": "ok",
        "seconds": compute_step_seconds(full),
    } | _build_size_columns(full)


def _build_variant_row(full: VariantRun, variant_run: VariantRun) -> ResultRow:
    row: ResultRow = {"kind": "ablated", "name": variant_run.variant.name}
    if variant_run.failure_reason:
        return row | {"status": "unsolvable", "reason": variant_run.failure_reason}
    assert full.scene is not None
    middle, low, high = compute_cost(full, variant_run)
    costs = {
        "seconds": compute_step_seconds(variant_run),
        "added_seconds": middle,
        "added_seconds_low": low,
        "added_seconds_high": high,
    }
    apart = compute_motion_difference(
        full.scene, (full.positions, full.velocities), (variant_run.positions, variant_run.velocities)
    )
    return row | {"status": "ok"} | costs | _build_size_columns(variant_run) | apart


def _build_size_columns(variant_run: VariantRun) -> ResultRow:
    assert variant_run.prepared is not None
    facts = variant_run.prepared.stats
    factor = facts.get("nnz_hessian_factor", facts.get("nnz_factor"))
    counts = {"nnz_system": facts.get("nnz_system"), "nnz_factor": factor}
    return {
        "memory_bytes": variant_run.memory_bytes,
        **{name: None if value is None else int(value) for name, value in counts.items()},
    }


def _measure_reference_errors(
    run: RunSpec, full: VariantRun, settings: SteppingSettings, tick: ProgressCallback
) -> list[ResultRow]:
    """Measure the error of the full scene's solver, and that of its time step.

    The first is the distance from the motion of converged steps. The second is the distance of that motion from the one
    with half the time step.
    """
    assert full.scene is not None
    settings = replace(settings, stop_criterion=CONVERGED_STOP_RULE)
    found: list[ResultRow] = []
    finer: MotionStates = (full.positions, full.velocities)
    for every, name in enumerate(_REFERENCE_KINDS, start=1):
        row: ResultRow = {"kind": "error", "name": name}
        try:
            scene = build_scene(run.scene.with_time_step(run.scene.time_step / every), run.size, run.integrator)
            coarser, finer = (
                finer,
                simulate_motion(scene, load_target(SOLVERS[REFERENCE_SOLVER])(), settings, stride=every),
            )
            found.append(row | {"status": "ok"} | compute_motion_difference(full.scene, coarser, finer))
        except Exception as error:  # the reference solver may raise any exception; the error is then unknown
            columns = build_failure_columns(error)
            found += [
                {"kind": "error", "name": n, "status": "failed", "reason": columns["reason"]}
                for n in _REFERENCE_KINDS[every - 1 :]
            ]
            break
        tick(f"error of the {name}")
    return found


def _add_shared_columns(run: RunSpec, scene: Scene, rows: list[ResultRow]) -> list[ResultRow]:
    """Add the columns that all rows share."""
    shared = build_specification_columns(run) | {
        "vertices": len(scene.mesh.rest_positions),
        "springs": len(scene.all_springs.edges),
        "frames": run.frames,
        "rounds": run.rounds,
        "bounding_box_diagonal": scene.mesh.bounding_box_diagonal / compute_mean_rest_length(scene),
    }
    return [shared | build_provenance_columns() | row for row in rows]


class EffectSuggestion(NamedTuple):
    """Kind of the suggested effect, and the evidence for it."""

    effect_kind: str
    evidence: str


def build_evidence(
    scene: Scene, effect_kinds: Collection[str], positions: NDArray[np.float64], velocities: NDArray[np.float64]
) -> ObservedMotion:
    """Collect the evidence from a scene and its motion.

    Args:
        scene: the scene.
        effect_kinds: kinds of its effects.
        positions: (frames, n, 3) [m].
        velocities: (frames, n, 3) [m/s].
    """
    return ObservedMotion(
        mesh=scene.mesh,
        springs=scene.all_springs,
        mean_spring_length=compute_mean_rest_length(scene),
        mass=scene.system.mass,
        time_step=scene.system.time_step,
        has_pins=bool(len(scene.system.pins.vertices)),
        is_driven=bool(scene.varying_forces or scene.pin_motions),
        is_damped=any(getattr(_load_effect_class(kind), "is_dissipative", False) for kind in effect_kinds),
        positions=positions,
        velocities=velocities,
    )


def suggest_effects(evidence: ObservedMotion, effect_kinds: Collection[str]) -> list[EffectSuggestion]:
    """Return the unlisted effects that the evidence indicates, in a fixed order.

    Each suggestion states its evidence. The class of an effect defines the evidence for it
    (`springbench.harness.scenes.effects.effect_interface.SceneEffect`).

    Args:
        evidence: evidence from the motion.
        effect_kinds: kinds of the effects that the scene lists.
    """
    absent = [
        kind
        for kind in EFFECT_CLASSES
        if kind not in effect_kinds and hasattr(_load_effect_class(kind), "find_evidence")
    ]
    suggestions = (EffectSuggestion(kind, _load_effect_class(kind).find_evidence(evidence)) for kind in absent)
    return [suggestion for suggestion in suggestions if suggestion.evidence]


def _load_effect_class(kind: str) -> Any:
    return load_target(EFFECT_TABLE[kind])
