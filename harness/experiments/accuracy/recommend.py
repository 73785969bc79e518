"""Find the cheapest method to simulate a scene up to an error.

It is selected from stored rows or new measurements.

An error is that of a whole simulation up to a horizon (`harness.experiments.accuracy.work`). A cost is the
wall time per simulated second. The result is the cheapest measured method that meets the error; one more simulation
checks it.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

from harness.base import machine, rows, shelf
from harness.base.claim import claimed
from harness.base.document import Document
from harness.base.errors import InputError, Mistake, RunFailed
from harness.base.progress import Display
from harness.config.accuracy import AccuracyFields, Case, How, WorkSpec
from harness.config.accuracy_load import Accuracy, expand
from harness.config.load import load_scene, misfits
from harness.config.options import OF_STEPS
from harness.config.solvers import solvers_of
from harness.config.sweep import SolverSpec
from harness.experiments.accuracy.accuracy_rows import SCHEMA
from harness.experiments.accuracy.best_first import SLOWER, Omitted, search
from harness.experiments.accuracy.studies import measuring
from harness.experiments.accuracy.units import references, trajectory_of
from harness.experiments.accuracy.work import work_rows
from harness.reference.frozen import bind
from harness.reference.self_converged import told_once, touches
from harness.reference.store import Store
from harness.scenes.mesh.generator import Generator
from harness.scenes.spec import SceneSpec
from solvers.about import LOCAL_GLOBAL
from solvers.registry import EVERY, SOLVERS, about, load, minimises

REFINEMENTS = (0.5, 1, 2, 4, 8)
"""Numbers of steps up to the horizon, relative to those at the scene's own time step."""

HORIZON = 1.0
"""Default simulated time at which the error counts [s]."""
BUDGET = 60.0
"""Default limit for the wall time of all measurements together [s]."""
_SAID = 2.0
"""Interval between two messages about the reference [s]."""
_SAME, _APART = 1e-6, 1.3
"""Relative difference of two errors of one simulation that compilers may cause; accepted ratio of its two times."""

TRIED = ["implicit-euler", "bdf2", "midpoint", "sdirk-4"]
"""Integrators to try: one of each order and kind."""


def candidates() -> list[dict[str, Any]]:
    """Return the grid that is measured where no rows exist.

    The first solver of each family runs with steps solved to a tolerance, or with 50 iterations or substeps. All
    adaptive solvers with their own integrator are included.
    """
    made = {name: load(target) for name, target in SOLVERS.items()}
    told = {name: about(solver, name) for name, solver in made.items()}
    own = [name for name, of in told.items() if of.own_steps and of.to_error]
    first = {name: made[name] for name, of in told.items() if of.first}
    implicit = [name for name, solver in first.items() if minimises(solver)]
    fixed = [name for name, solver in first.items() if not minimises(solver) or told[name].family == LOCAL_GLOBAL]
    return [
        {"solver": implicit, "tolerance": [1e-1, 1e-2, 1e-3], "iterations": 500, "integrator": TRIED},
        {"solver": fixed, "iterations": 50},
        {"solver": own, "iterations": 1, "integrator": ["own"]},
    ]


@dataclass(frozen=True, slots=True)
class Recommended:
    """Method that was measured on the scene.

    Attributes:
        spec: the simulation.
        error: relative error.
        cost: wall time per simulated second.
        truth: kind of the reference solution for the error.
        choice: what the solver selected automatically.
        sweep: name of the study that measured it.
    """

    spec: WorkSpec
    error: float
    cost: float
    truth: str
    choice: str
    sweep: str = ""

    def __str__(self) -> str:
        u = self.spec
        if about(load(EVERY[u.solver.name]), u.solver.name).own_steps:
            return f"solver {u.solver.name}, {self.choice}, in each frame of {u.case.scene.time_step:.6g} s"
        tolerance = u.options["tolerance"]
        stop = f"{u.options['iterations']} iterations" if tolerance is None else f"tolerance {tolerance:g}"
        return f"{u.case.integrator}, time step {u.case.scene.time_step:.6g} s, {stop}, solver {u.solver.name}"

    def command(self, scene: Path) -> str:
        """Return the command line for this method; empty where the solver's parameters need a sweep."""
        u, made = self.spec, load(EVERY[self.spec.solver.name])
        if made(**u.solver.parameters) != made():
            return ""
        steps = round(u.horizon / u.case.scene.time_step)
        given: dict[str, Any] = {"size": u.case.size or None, "solver": u.solver.name, "integrator": u.case.integrator}
        given |= {"time-step": repr(u.case.scene.time_step), "frames": steps, **u.options}
        said = ((name.replace("_", "-"), value) for name, value in given.items() if value is not None)
        options = (part for name, value in said for part in (f"--{name}", str(value)))
        return shlex.join(["springbench", "run", str(scene), *options])


@dataclass(frozen=True, slots=True)
class Recommendation:
    """Result of a recommendation.

    Attributes:
        ways: all measured methods, cheapest first.
        best: cheapest of those that meet the error.
        checked: a repeated measurement of it.
    """

    ways: tuple[Recommended, ...]
    best: Recommended
    checked: Recommended

    @property
    def verdict(self) -> str:
        """Comparison of the predicted with the repeated measurement, as text."""
        before, now = self.best, self.checked
        if not math.isclose(now.error, before.error, rel_tol=_SAME):
            return (
                f"not as predicted: the error is {now.error:.3g}, not {before.error:.3g}; what was measured before is "
                "not this simulation, so remove it and repeat the command"
            )
        ratio = now.cost / before.cost
        if not 1.0 / _APART <= ratio <= _APART:
            return (
                f"the error is as predicted, the time {ratio:.2g} times that: other programs ran beside one of the "
                "two, so repeat the command on an idle machine before you rely on the time"
            )
        return f"as predicted: the same error, {ratio:.2g} times the time"


def recommend(
    path: Path,
    error: float,
    *,
    size: int | None,
    horizon: float | None,
    time_limit: float,
    results: Path,
    display: Display,
    say: Callable[[str], None],
    budget: float = BUDGET,
) -> Recommendation:
    """Return the cheapest method for a relative error at `horizon`.

    Args:
        path: file of the scene.
        error: relative error to reach.
        size: mesh size; the scene's default if None.
        horizon: simulated time [s]. If None, HORIZON, or the longest time at which the error can be measured, if
            that is shorter.
        time_limit: wall-time limit of a simulation [s].
        results: folder that contains a folder for each config.
        display: shows progress.
        say: prints a remark.
        budget: limit for the wall time of all measurements together [s].

    Raises:
        InputError: an option is invalid.
        RunFailed: no method meets the error.
    """
    asked_for = {"--error": error, "--horizon": horizon, "--time-limit": time_limit, "--budget": budget}
    for key, value in asked_for.items():
        if value is not None and not 0 < value < math.inf:
            raise InputError(Mistake(f"came {value:g}; wanted a number above 0", key=key))
    scene = load_scene(path)
    scene.require_even_steps()
    size = (size or scene.default_size or 0) if isinstance(scene.mesh, Generator) else 0
    store = references(results)
    if horizon is None:
        horizon = _longest(path, scene, size, error, store, say)
    try:
        asked = _grid(path, scene, size, horizon, time_limit)
    except InputError as refused:  # the studies are ours; what is wrong came with an option
        raise InputError(list(dict.fromkeys(map(_of_option, refused.mistakes)))) from refused
    _referenced(scene, size, error, horizon, store, say)
    ways, reasons = _known(path.stem, scene, size, horizon, results)
    omitted: Omitted | None = None
    if not any(way.error <= error and way.sweep != asked.name for way in ways):
        omitted = _measured(asked, ways, reasons, error, claimed(results / asked.name, path), display, say, budget)
        say(f"{path.stem} {size or ''}: {omitted}")
        ways, reasons = _known(path.stem, scene, size, horizon, results)
    within = [way for way in ways if way.error <= error]
    if not within:
        raise RunFailed(_nothing(ways, reasons, error, horizon, omitted))
    best = within[0]
    say(f"checking {best}")
    return Recommendation(tuple(ways), best, _check(best, store))


def _longest(path: Path, scene: SceneSpec, size: int, error: float, store: Store, say: Callable[[str], None]) -> float:
    """Return the default end time [s]. Raises InputError, Unpredictable."""
    if mistakes := misfits(scene, [size]):
        raise InputError(mistakes)
    if touches(bind(scene, size).system):
        return HORIZON
    seen = store.growth(scene, size, HORIZON)
    if seen.least <= error:
        return HORIZON
    longest = seen.longest(error)
    if not longest:
        seen.require(error)
    say(
        f"{path.stem} {size or ''}: an error of {error:g} can be measured up to {longest:g} s, for a perturbation of "
        f"1e-12 of the size grows to {seen.grown[-1]:.1e} of the displacement after {HORIZON:g} s"
    )
    return longest


def _referenced(
    scene: SceneSpec, size: int, error: float, horizon: float, store: Store, say: Callable[[str], None]
) -> None:
    """Compute the reference, or report without delay why there is none. Raises RunFailed."""
    if touches(bind(scene, size).system):
        say(told_once(scene.path.stem))
    say(f"the reference first, the motion up to {horizon:g} s, which is made once")
    last = [monotonic()]

    def told(motion: int, time: float) -> None:
        if monotonic() - last[0] > _SAID:
            last[0] = monotonic()
            say(f"  motion {motion} of 2, at {time:.3g} of {horizon:g} s")

    store.trajectory(scene, size, [horizon], error=error, told=told)


def _measured(
    asked: Accuracy,
    ways: list[Recommended],
    without: list[dict[str, Any]],
    error: float,
    folder: Path,
    display: Display,
    say: Callable[[str], None],
    budget: float,
) -> Omitted:
    """Measure the methods that may be the cheapest and have no rows. Raises InputError, CannotWrite."""
    known: dict[str, dict[str, Any]] = {
        way.spec.label(): {"status": "ok", "error": way.error, "seconds_per_simulated": way.cost} for way in ways
    }
    failed, here = {row["unit"]: row for row in without}, machine.describe().id
    say(
        f"measuring up to {len(asked.work)} settings, cheap ones first, for at most {budget:g} s (--budget); a "
        f"simulation ends once it is {SLOWER:g} times as slow as the best that keeps to the error"
    )
    with measuring(asked.work, folder, display) as measure:

        def look_up(spec: WorkSpec) -> dict[str, Any]:
            return known.get(spec.label()) or failed.get(spec.unit_id(here)) or measure(spec)

        best = min((way.cost for way in ways if way.error <= error), default=math.inf)
        return search(asked.work, error, best, look_up, budget)


def _grid(path: Path, scene: SceneSpec, size: int, horizon: float, time_limit: float) -> Accuracy:
    """Build the study that is measured where no rows exist."""
    steps = max(1, round(horizon / scene.time_step))
    time_steps = [horizon / round(steps * factor) for factor in REFINEMENTS if round(steps * factor)]
    shared = {"horizon": horizon, "time_step": time_steps, "time_limit": time_limit} | ({"size": size} if size else {})
    work: list[dict[str, Any]] = [shared | way for way in candidates()]
    solvers = list(dict.fromkeys(name for way in work for name in way["solver"]))
    data = {"scenes": [path.name], "solvers": solvers, "work": work}
    document = Document(path, data)
    fields = document.check(AccuracyFields, data)
    solvers = solvers_of(document)
    if fields is None or document.mistakes:
        raise document.error()
    return replace(expand(document, fields, {path.stem: scene}, solvers), name=f"recommend-{path.stem}")


def _of_option(mistake: Mistake) -> Mistake:
    """Convert a mistake in a study to one in a command-line option."""
    return Mistake(mistake.problem, key="--" + mistake.key.rpartition(".")[2].replace("_", "-"))


def _known(
    name: str, scene: SceneSpec, size: int, horizon: float, results: Path
) -> tuple[list[Recommended], list[dict[str, Any]]]:
    """Read the rows of this scene on this machine.

    Returns the methods that have an error, cheapest first, and the rows of those that have none.
    """
    here, ways, without = machine.describe().id, list[Recommended](), list[dict[str, Any]]()
    units = (unit for folder in shelf.folders(results, "accuracy", "*/") for unit in shelf.units(folder))
    for path in sorted(unit for unit in units if unit.name.startswith(f"{name}-{size}-work-")):
        row = rows.read([path], SCHEMA).to_pylist()[0]
        spec = _spec(row, name, scene)
        if path.stem != spec.label() or row["machine"] != here or row["horizon"] != horizon:
            continue  # the scene was another then, or the machine, or the question
        if row["status"] == "ok":
            ways.append(_recommended(spec, row))
        else:
            without.append(row)
    return sorted(ways, key=lambda way: way.cost), without


def _spec(row: dict[str, Any], name: str, scene: SceneSpec) -> WorkSpec:
    """Build the specification that a row was measured with, assuming an unchanged scene."""
    case = Case(name, scene.stepped(row["time_step"]), row["size"], row["integrator"])
    solver = SolverSpec(row["solver"], json.loads(row["parameters"]))
    how = How(row["threads"], rounds=1, time_limit=float("inf"))
    return WorkSpec(case, row["horizon"], solver, {name: row[name] for name in OF_STEPS}, how)


def _check(best: Recommended, store: Store) -> Recommended:
    """Repeat the measurement of a method."""
    row = work_rows(best.spec, trajectory_of(best.spec, store), lambda: None)[0]
    if row["status"] != "ok":
        raise RunFailed(f"the check of {best} ended otherwise than before: {row['status']}: {row['reason']}")
    return _recommended(best.spec, row)


def _recommended(spec: WorkSpec, row: dict[str, Any]) -> Recommended:
    return Recommended(
        spec,
        row["error"],
        row["seconds_per_simulated"],
        row["truth"] or "integrated",
        row["choice"] or "",
        row.get("sweep") or "",
    )


def _nothing(
    ways: list[Recommended], without: list[dict[str, Any]], error: float, horizon: float, omitted: Omitted | None
) -> str:
    """Explain why no method meets the error, and suggest what to change."""
    if omitted and not omitted.complete:
        return (
            f"nothing that was measured keeps to an error of {error:g} over {horizon:g} s, and settings remain "
            f"({omitted}): the same command with a larger --budget goes on where this one ended"
        )
    if ways:
        nearest = min(ways, key=lambda way: way.error)
        return (
            f"nothing that was measured keeps to an error of {error:g} over {horizon:g} s; the nearest is {nearest}, "
            f"which errs by {nearest.error:.2g}: ask for a larger --error or a shorter --horizon"
        )
    reasons = {row["reason"] for row in without}
    return f"no error over {horizon:g} s could be measured: {'; '.join(sorted(reasons)) or 'nothing was simulated'}"
