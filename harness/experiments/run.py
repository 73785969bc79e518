"""Execute one run: build its objects, run all passes, write the files.

The timed passes come first and record nothing. Recording, energies and pictures come from an instrumentation pass. Its
final positions must be bitwise identical to the timed ones. The rows are written last: where they exist, the run is
complete.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.base import machine, rows
from harness.base.errors import InputError, RunFailed
from harness.base.files import replacing
from harness.base.machine_lock import Turn, alone, beside, own_cores
from harness.base.quantities import ms_per_step
from harness.base.worker import Tick
from harness.config.sweep import RunSpec
from harness.experiments.ability import of_this_machine
from harness.experiments.code import TO_ERROR, code, parts, solver_class
from harness.experiments.failure import failure, grown
from harness.experiments.plan import Files
from harness.experiments.provenance import asked, common, tolerance
from harness.record.base import SELF_CONTACT, Frame, FrameSamples, RecordingInfo
from harness.record.obstacles import listed
from harness.record.rerun import RerunRecorder
from harness.record.shading import strain_range
from harness.record.verify import require_frames
from harness.reference.grade import Graded
from harness.reference.judge import Judge, reference
from harness.scenes.bind import Scene, build
from harness.scenes.effects.springs import Springs
from harness.scenes.material import modulus_exponent
from harness.simulation import times
from harness.simulation.algebraic import stop_rule
from harness.simulation.clock import measured_again
from harness.simulation.energy_balance import Growth
from harness.simulation.measure import Measured, Settings, StepFailed, digest, measure, roughly
from harness.simulation.observe import observe, require_numbers
from harness.simulation.on_device import columns as device_columns
from harness.simulation.step import prepare
from solvers import sources
from solvers.problem import Positions, Solver
from solvers.registry import SOLVERS, load, minimises


def execute(
    run: RunSpec, files: Files, tick: Tick, *, positions: Path | None = None, at_once: int = 1
) -> list[dict[str, Any]]:
    """Execute one run, write its files and return its rows.

    A failure is a row with status and reason.

    Args:
        run: specification of the run.
        files: paths of its files.
        tick: called with the name of the pass after each step.
        positions: where to store the positions after every step, (frames, n, 3) [m], float64; None for not at all.
        at_once: number of runs that may be timed concurrently.

    Raises:
        InputError: the input is invalid, and the run has no user code.
        CannotWrite: the files cannot be written; there are then no rows.
    """
    shared: dict[str, Any] = {"at_once": at_once, **of_this_machine(tick)}
    threads = machine.threads(run.threads)
    with machine.pinned_threads(threads.number), Turn(tick, exclusive=run.timing == "exclusive") as turn:
        with turn.ready():
            shared |= common(run) | {"code": code(parts(run))}
        try:
            run = run.but(scene=run.scene.opened())
            found = _passes(run, files, tick, positions, turn)
        except Exception as error:  # a solver may fail in any way; the sweep goes on, and the row says where it was
            if isinstance(error, InputError) and not run.own():
                raise
            turn.look()
            own = _own_files(run)
            found = [_earliest(run, failure(error, own), own)]
            for earlier in (files.recording, files.picture):  # of a time when it did not fail; they would hide this
                earlier.unlink(missing_ok=True)
            if run.record and "frame" in found[0]:
                _record_until(run, files, found[0])
        if threads.why:
            for row in found:
                row["choice"] = "; ".join(filter(None, [row.get("choice"), threads.why]))
        result = [shared | row for row in found]
        content = rows.encoded(result)
    rows.store(files.rows, content)  # who waits for the disk computes nothing, and disturbs nobody who is timed
    return result


def _passes(run: RunSpec, files: Files, tick: Tick, positions: Path | None, turn: Turn) -> list[dict[str, Any]]:
    """Run all passes and return the rows.

    The timing session is checked for disturbances at the end.
    """
    if run.accuracy is not None:
        return _to_error(run, run.accuracy, files, tick, positions, turn)
    with turn.ready():
        scene = build(run.scene, run.size, run.integrator)
    counts = {"vertices": len(scene.mesh.rest), "springs": len(scene.springs.edges)}
    settings = _settings(run)
    with _timed(run, tick) as how:
        if run.timing == "rough":
            measured, told = roughly(scene, _solver(run)), None
        else:
            measured, told = _measured(scene, _solver(run), settings, tick)
        where = device_columns(measured.prepared)
    turn.look()
    by_frame = _second_pass(run, files, scene, measured, settings, tick, positions)
    told = told or times.rows(measured)
    require_numbers(by_frame, minimises=minimises(_solver(run)), tolerance=isinstance(run.tolerance, float))
    stands = _standing(run, by_frame)
    facts: dict[str, Any] = {name: int(value) for name, value in measured.prepared.facts.items()}
    facts |= {"choice": measured.prepared.choice, "modulus_exponent": _modulus_exponent(run, scene)}
    facts |= where | stands | how
    return [counts | facts | row | (by_frame[row["frame"]] if row["phase"] == "step" else {}) for row in told]


def _modulus_exponent(run: RunSpec, scene: Scene) -> int | None:
    """Return how the spring stiffness scales with mesh size.

    The result is None without springs or with several rules.
    """
    rules = {effect.rule for effect in run.scene.effects if isinstance(effect, Springs)}
    found = {modulus_exponent(rule, scene.mesh.dimension) for rule in rules}
    return found.pop() if len(found) == 1 else None


def _standing(run: RunSpec, by_frame: Mapping[int, Mapping[str, Any]]) -> dict[str, str]:
    stands = {"status": "ok"}
    if run.judge:
        from harness.experiments.standing import standing  # for which those whom nobody judges need not wait

        stands = standing(run)
    growth = Growth.of(by_frame) if stands["status"] == "ok" else None
    return stands | (grown(run, growth, by_frame) if growth else {})


@measured_again
def _measured(scene: Scene, solver: Solver, settings: Settings, tick: Tick) -> tuple[Measured, list[dict[str, Any]]]:
    measured = measure(scene, solver, settings, tick)
    return measured, times.rows(measured)


def _to_error(
    run: RunSpec, error: float, files: Files, tick: Tick, positions: Path | None, turn: Turn
) -> list[dict[str, Any]]:
    """Return the rows of an error-controlled run, whose integrator and step size are chosen first."""
    with _timed(run, tick) as how:
        found = load(TO_ERROR)(run, error, tick)
    told, seen, last = found.rows(), found.positions, dict[str, Any]()
    turn.look()
    if positions:
        save_positions(positions, seen[1:])
    if run.record:
        chosen = {name: told[0][name] for name in ("status", "integrator", "estimated")}
        recorder = _recorder(run, files, found.scene, chosen | {"milliseconds_per_step": found.ms_per_step}, seen[-1])
        try:
            for k, p in enumerate(seen):
                recorder.frame(Frame(k, found.scene.time(k), p, {}, float("nan"), 0))
            recorder.close({})
        finally:
            recorder.abandon()
        chosen = sorted(FrameSamples(run.frames).frames)
        due = {k: found.scene.time(k) for k in chosen}
        last = {"recorded": require_frames(files.recording, recorder.info, due, {k: seen[k] for k in chosen})}
    return [how | row | (last if row["frame"] == run.frames else {}) for row in told]


@contextmanager
def _timed(run: RunSpec, tick: Tick) -> Generator[dict[str, Any]]:
    """Hold the run's timing lock (exclusive, shared, own cores), and yield its columns."""
    if run.timing != "shared":
        with (alone if run.timing == "exclusive" else beside)(tick):
            yield {}
    else:
        with own_cores(machine.threads(run.threads).number, tick) as cores:
            yield {"pinned": " ".join(map(str, cores))}


def _second_pass(
    run: RunSpec,
    files: Files,
    scene: Scene,
    measured: Measured,
    settings: Settings,
    tick: Tick,
    positions: Path | None,
) -> dict[int, dict[str, Any]]:
    """Repeat the simulation and observe energies, convergence, positions and the recording."""
    stored = np.empty((run.frames, len(scene.mesh.rest), 3)) if positions else None
    samples = FrameSamples(run.frames)
    with ExitStack() as cleanup:
        recorder = None
        if run.record:
            assert measured.final is not None  # a sweep that is rough and records is refused
            seconds = [t.seconds for t in measured.timings if t.phase == "step"]
            facts = {"status": "ok", "milliseconds_per_step": ms_per_step(seconds)}
            recorder = _recorder(run, files, scene, facts, measured.final)
            cleanup.callback(recorder.abandon)
        graded = Graded(measured.prepared, _solver(run), {1, (run.frames + 1) // 2, run.frames})
        found = observe(
            scene,
            graded,
            settings,
            recorder=recorder,
            convergence={1, (run.frames + 1) // 2, run.frames}
            if run.convergence_frames is None
            else run.convergence_frames,
            stored=stored,
            sample=samples.add if recorder else None,
            judge=_judge(run, scene),
            tick=lambda: tick("second pass"),
            clock=measured.clock,
        )
        if measured.final is not None and found[run.frames]["digest"] != digest(measured.final):
            raise RunFailed("the recorded pass ended at other positions than the timed pass")
        if recorder and measured.final is not None:
            stands = _standing(run, found)
            ended = {name: stands[name] for name in ("status", "reason")} if stands["status"] != "ok" else None
            recorder.close(times.milliseconds(measured, run.frames), ended)
            due = {frame: scene.time(frame) for frame in samples.frames}
            motion = samples.positions | {run.frames: measured.final}
            found[run.frames]["recorded"] = require_frames(files.recording, recorder.info, due, motion)
    if positions and stored is not None:
        save_positions(positions, stored)
    return {frame: graded.found.get(frame, {}) | columns for frame, columns in found.items()}


def _earliest(run: RunSpec, failed: dict[str, Any], own: Collection[Path]) -> dict[str, Any]:
    """Return the row of a failed run; after divergence, that of the first diverged frame.

    Timed passes detect only positions that are not finite, which may occur later.
    """
    if failed["status"] != "diverged" or "frame" not in failed:
        return failed
    settings = replace(_settings(run), frames=failed["frame"] - 1)
    try:
        scene = build(run.scene, run.size, run.integrator)
        observe(
            scene,
            prepare(scene, _solver(run)),
            settings,
            recorder=None,
            convergence=(),
            stored=None,
            judge=None,
            tick=lambda: None,
        )
    except StepFailed as earlier:
        return failure(earlier, own)
    except Exception:  # what went wrong is known already
        return failed
    return failed


def _record_until(run: RunSpec, files: Files, failed: dict[str, Any]) -> None:
    """Record the frames before the failed one and mark the recording.

    Nothing is recorded if they fail too.
    """
    facts = {"status": failed["status"], "reason": failed["reason"], "failed_frame": failed["frame"]}
    settings = replace(_settings(run), frames=failed["frame"] - 1)
    with ExitStack() as cleanup, suppress(Exception):  # what went wrong is told already
        scene = build(run.scene, run.size, run.integrator)
        prepared = prepare(scene, _solver(run))
        recorder = _recorder(run, files, scene, facts)
        cleanup.callback(recorder.abandon)
        observe(
            scene, prepared, settings, recorder=recorder, convergence=(), stored=None, judge=None, tick=lambda: None
        )
        recorder.close({})


def _own_files(run: RunSpec) -> frozenset[Path]:
    """Return the source files of the solver, in which an error is located first."""
    try:
        return sources.of_class(solver_class(run))
    except Exception:  # it is somebody's own, and cannot be imported; that is the error
        return frozenset()


def _settings(run: RunSpec) -> Settings:
    return Settings(stop_rule(run.iterations, run.tolerance), run.first_guess, run.frames, run.rounds)


def _solver(run: RunSpec) -> Solver:
    return solver_class(run)(**run.solver.parameters)


@dataclass(frozen=True, slots=True)
class _Motion:
    """Cache key: a run's scene and the other settings that determine its motion."""

    key: tuple[str | int, ...]
    run: RunSpec = field(compare=False)


def _judge(run: RunSpec, scene: Scene) -> Judge | None:
    if not run.judge:
        return None
    key = (run.scene.digest, run.size, run.integrator, run.first_guess, run.frames)
    return Judge(scene, _reference(_Motion(key, run)), minimises=minimises(_solver(run)))


@lru_cache(maxsize=1)
def _reference(motion: _Motion) -> NDArray[np.float64] | None:
    """Return the reference motion of a scene; None where Newton's method fails.

    One entry is cached, for the runs of a scene are consecutive.
    """
    run = motion.run
    scene = build(run.scene, run.size, run.integrator)
    try:
        return reference(scene, load(SOLVERS["newton"])(), first_guess=run.first_guess, frames=run.frames)
    except Exception:  # the row of Newton's method itself says what it was
        return None


def _recorder(run: RunSpec, files: Files, scene: Scene, facts: Mapping[str, Any], *ends: Positions) -> RerunRecorder:
    """Open the recording of a run.

    `facts` is how the run ended, stored among the recording's properties. `ends` set the colour scale.
    """
    files.recording.parent.mkdir(parents=True, exist_ok=True)
    here = machine.describe()
    properties = {
        "sweep": run.sweep,
        **{name: value for name, value in asked(run).items() if value is not None},  # a property has no null
        "tolerance": tolerance(run.tolerance) or 0.0,
        "vertices": len(scene.mesh.rest),
        "springs": len(scene.springs.edges),
        "frames": run.frames,
        **facts,
        SELF_CONTACT: scene.self_contact,
        "cpu": here.cpu,
        "cores": here.cores,
        "memory_gib": here.memory_gib,
        "system": here.system,
        "commit": machine.commit(),
        **{f"version_{name}": version for name, version in machine.versions().items()},
    }
    size = f" {run.size}" if run.size else ""
    return RerunRecorder(
        files.recording,
        RecordingInfo(
            title=f"{run.scene_name}{size} - {run.solver.name}",
            run_id=run.run_id(here.id),
            mesh=scene.mesh,
            springs=scene.springs.edges,
            rest_lengths=scene.springs.rest_length,
            pinned=scene.system.pins.vertices,
            time_step=run.scene.time_step,
            strain_range=run.strain_range or strain_range(ends, scene.springs.edges, scene.springs.rest_length),
            properties=properties,
            obstacles=listed(run.scene.effects),
        ),
    )


def save_positions(path: Path, positions: np.ndarray) -> None:
    """Store positions (frames, n, 3) [m] in a partial file and rename it. Raises CannotWrite."""
    with replacing(path) as partial:
        np.savez_compressed(partial, positions=positions)
