"""Run `springbench run SCENE --error 1e-3`: simulate a scene to an error.

It writes a row and a recording.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

from harness.base import machine, rows
from harness.base.claim import claimed
from harness.base.errors import InputError, Mistake, RunFailed
from harness.base.stated import stated
from harness.config.load import load_scene
from harness.experiments.accuracy.accuracy_rows import SCHEMA
from harness.experiments.accuracy.units import references
from harness.experiments.apart import apart
from harness.experiments.asked.known import Row, known, problem, promising, way_rows
from harness.experiments.asked.peers import peers as peers_of
from harness.experiments.asked.search import Answer, foresee, search
from harness.experiments.asked.ways import Asked, in_words
from harness.experiments.provenance import provenance
from harness.experiments.run import save_positions
from harness.record.base import Frame, RecordingInfo
from harness.record.rerun import RerunRecorder
from harness.record.shading import strain_range
from harness.reference.growth import Growth
from harness.scenes.spec import SceneSpec
from solvers.problem import Positions

Say = Callable[[str], None]
_SHARED = ("sweep", "scene", "size", "vertices", "threads", "horizon", "asked")
"""Columns that the rows of third-party integrators share."""


def run_to_error(
    config: Path,
    error: float,
    results: Path,
    say: Say,
    *,
    horizon: float | None = None,
    sizes: Sequence[int] = (),
    check: bool = False,
    peers: bool = False,
    positions: Path | None = None,
    again: bool = False,
    others: Mapping[str, Any] | None = None,
) -> bool:
    """Simulate the scene in a file to a relative error, and print the cost.

    Args:
        config: file of the scene.
        error: relative error at horizon.
        results: folder of results.
        say: prints a remark.
        horizon: simulated time [s]; that of the scene if None.
        sizes: mesh sizes, at most one.
        check: whether to compare with the reference solution.
        peers: whether to time third-party integrators too.
        positions: where to store the positions of the frames; None for not at all.
        again: whether to try all methods, even those that were expensive according to stored rows.
        others: other options on the command line, which are not supported here.

    Returns: whether the verification passes; True without verification.

    Raises:
        InputError: an option is invalid.
        RunFailed: no method reaches the error.
    """
    _require(error, horizon, {**(others or {}), "second --size": sizes[1:]})
    scene = load_scene(config)
    given = config, scene, error, results, horizon, sizes[0] if sizes else None, check, peers, positions, again
    return apart(partial(_done, *given), [plugin for plugin, _ in scene.own.values()], say)


def _done(
    config: Path,
    scene: SceneSpec,
    error: float,
    results: Path,
    horizon: float | None,
    size: int | None,
    check: bool,
    peers: bool,
    positions: Path | None,
    again: bool,
    say: Say,
) -> bool:
    asked = Asked.of(scene, size, horizon, say)
    folder = claimed(results / config.stem, config)
    with machine.pinned_threads(1):
        seen = foresee(asked, error, say)
        before = known(folder / "accuracy", asked)
        answer = _searched(asked, error, seen, [] if again else before, say)
    path, best = answer.best.path, answer.best
    say(f"asked {error:g}, estimated {best.estimated:.1g}, {path.processor:.3g} s of processor time")
    factors = f", {path.factorisations} factorisations" if path.factorisations else ""
    say(
        f"by {best.way}: {path.accepted} steps, {path.rejected} rejected{factors}"
        + (f"; more exact than asked, for {answer.note}" if answer.note else "")
    )
    say(f"choosing, and a closer motion for the estimate, took {answer.seconds:.3g} s besides")
    measured = _checked(asked, error, path.positions[-1], results, say) if check else None
    label = f"{config.stem}-{asked.size}-asked-{error:g}-{asked.horizon:g}"
    recording = _record(folder / "recordings" / f"{label}.rrd", config.stem, asked, answer)
    row = _row(config.stem, asked, error, answer) | {"error": measured, "recording": f"recordings/{recording.name}"}
    (folder / "accuracy").mkdir(exist_ok=True)
    found = [row, *(_beside(row, asked, error, answer, say) if peers else ())]
    shared = {name: row[name] for name in (*_SHARED, "problem")} | provenance()
    found += [shared | way for way in way_rows(answer, before, error)]
    rows.write(folder / "accuracy" / f"{label}.parquet", [one | {"unit": label} for one in found], SCHEMA)
    if positions:
        save_positions(positions, path.positions[1:])
    say(f"the row is in {folder / 'accuracy'}, the recording is {recording}")
    return not check or (measured is not None and measured <= error)


def _searched(asked: Asked, error: float, seen: Growth, before: Sequence[Row], say: Say) -> Answer:
    """Search the cheapest method, first among those that were cheap for a similar error.

    Raises RunFailed.
    """
    nearest, pairs = promising(before, error)
    if not pairs:
        return search(asked, error, seen, say)
    names = ", ".join(in_words(integrator, solver.name) for integrator, solver in pairs)
    say(f"worth trying by rows measured before, for an error of {nearest:g}: {names}; --again tries all ways")
    try:
        return search(asked, error, seen, say, pairs)
    except RunFailed as failed:
        say(f"{failed}; so all ways are tried")
        return search(asked, error, seen, say)


def _checked(asked: Asked, error: float, p: Positions, results: Path, say: Say) -> float | None:
    """Print and return the error of positions p (n, 3) [m] against the reference.

    The result is None if there is none.
    """
    try:
        trajectory = references(results).trajectory(asked.scene, asked.size, [asked.horizon], error=error)
    except RunFailed as failed:
        say(f"the reference cannot grade it: {failed}")
        return None
    measured = trajectory.error(-1, p)
    say(f"by the reference it errs by {measured:.2g}, {'as' if measured <= error else 'not as'} asked")
    return measured


def _require(error: float, horizon: float | None, others: Mapping[str, Any]) -> None:
    """Raise InputError for invalid options."""
    mistakes = [
        Mistake("with --error, solver and steps are chosen; leave it out", key=f"--{name.replace('_', '-')}")
        for name, value in others.items()
        if value
    ]
    if not 0.0 < error < 1.0:
        mistakes.append(Mistake(f"came {error:g}; wanted a number between 0 and 1", key="--error"))
    if horizon is not None and not (isfinite(horizon) and 0.0 < horizon <= 1e4):
        mistakes.append(Mistake(f"came {horizon:g}; wanted seconds above 0, at most 10,000", key="--horizon"))
    if mistakes:
        raise InputError(mistakes)


def _row(name: str, asked: Asked, error: float, answer: Answer) -> dict[str, Any]:
    best, path = answer.best, answer.best.path
    return {
        "kind": "asked",
        "status": "ok",
        "reason": answer.note,
        "sweep": name,
        "scene": name,
        "problem": problem(asked),
        "size": asked.size,
        "vertices": path.positions.shape[1],
        "solver": best.way.solver,
        "parameters": json.dumps({}),
        **stated(best.way.solver),
        "time_step": asked.frame,
        "threads": 1,
        "horizon": asked.horizon,
        "asked": error,
        **best.columns,
        "iterations_done": path.iterations,
        "seconds": [path.seconds],
        "cpu_seconds": path.processor,
        "seconds_per_simulated": path.seconds / asked.horizon,
        "estimate_seconds": answer.seconds,
        **provenance(),
    }


def _beside(row: dict[str, Any], asked: Asked, error: float, answer: Answer, say: Say) -> list[dict[str, Any]]:
    """Build the rows of third-party integrators, and print their relative times."""
    shared = {name: row[name] for name in _SHARED} | provenance()
    found = list[dict[str, Any]]()
    say("beside it, on the same machine in the same process, to the same error:")
    for peer in peers_of(asked, error, answer):
        told = f"{peer.ratio:.3g} times the processor time, an error of {peer.estimated:.1g}"
        say(f"  {peer.name}: {peer.reason or told}")
        became = {"status": "failed", "reason": peer.reason} if peer.reason else {"status": "ok"}
        times = (
            {} if peer.reason else {"seconds": [peer.seconds], "seconds_per_simulated": peer.seconds / asked.horizon}
        )
        estimated = {} if peer.reason else {"estimated": peer.estimated}
        found.append(shared | became | times | estimated | {"kind": "peer", "solver": peer.name})
    return found


def _record(path: Path, name: str, asked: Asked, answer: Answer) -> Path:
    """Write the recording of the motion, with the requested error as a property."""
    scene, best, here = asked.bound(asked.frame, "own"), answer.best, machine.describe()
    properties = {"scene": name, "size": asked.size, "solver": best.way.solver, "integrator": best.way.integrator}
    info = RecordingInfo(
        title=f"{name} {asked.size or ''}".strip() + f" - {best.way}, estimated error {best.estimated:.1g}",
        run_id=f"{path.stem}-{here.id}",
        mesh=scene.mesh,
        springs=scene.springs.edges,
        rest_lengths=scene.springs.rest_length,
        pinned=scene.system.pins.vertices,
        time_step=asked.frame,
        strain_range=strain_range(best.path.positions[-1:], scene.springs.edges, scene.springs.rest_length),
        properties={
            **properties,
            "status": "ok",
            "estimated": best.estimated,
            "cpu": here.cpu,
            "commit": machine.commit(),
        },
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    recorder = RerunRecorder(path, info)
    try:
        for k, p in enumerate(best.path.positions):
            recorder.frame(Frame(k, k * asked.frame, p, {}, float("nan"), 0))
        return recorder.close({})
    finally:
        recorder.abandon()
