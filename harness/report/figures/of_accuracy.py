"""Panels of `springbench accuracy`: convergence, time to accuracy, work-precision, profiles, scaling, Liu et al.
2013.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from harness.report.accuracy.convergence import GUESSES
from harness.report.accuracy.growth import TARGET, growths
from harness.report.accuracy.measured import (
    Curve,
    Measurements,
    Problem,
    Values,
    WorkPoint,
    by_other_code,
    by_self_converged,
    older,
    stop_words,
    without_short,
)
from harness.report.accuracy.profiles import iteration_ratios, judged, least_ratios, not_shown, share, yardstick
from harness.report.accuracy.reading import read
from harness.report.accuracy.time_plot import middle
from harness.report.accuracy.times import STEPS, TARGETS, left_out
from harness.report.accuracy.work_plot import front
from harness.report.figures.entry import Entry, ready
from harness.report.figures.panel import Band, Plot, Scale, Series
from harness.report.figures.scales import power
from harness.report.page import count, quantity
from harness.report.style import MUTED, OLDER, Mark, looks

_LEAST = 1e-16
_QUANTITIES: dict[str, tuple[str, Callable[[Curve], Values]]] = {
    "gap": ("energy gap (g − g*) / (g₀ − g*)", lambda curve: curve.gap),
    "largest": ("largest vertex error [mean rest lengths]", lambda curve: curve.largest),
    "stationarity": ("stationarity |Q⁻¹∇g|, relative to the start", lambda curve: curve.stationarity),
}
_AGAINST = {"time": Scale("wall time", "log", "time"), "iterations": Scale("iterations", "iterations", "plain")}
WANTED = "rows of `springbench accuracy CONFIG`"


def convergence(folder: Path) -> list[Entry]:
    """Build panels of error against time and iterations, for each step snapshot and initial guess."""
    table = without_short(read(folder))
    marked = looks((curve.label, curve.solver) for curve in table.curves)
    found: list[Entry] = []
    for problem in table.problems:
        for guess in GUESSES:
            curves = [c for c in table.curves if c.problem is problem and c.first_guess == guess and len(c.iterations)]
            of = (problem.scene, str(problem.size), problem.moment, guess)
            for quantity_, against in ((q, a) for q in _QUANTITIES for a in _AGAINST if curves):
                plot = _converging(of, quantity_, against, problem, curves, marked, table)
                found += ready([plot])
    return found


def _converging(
    of: tuple[str, ...],
    what: str,
    against: str,
    problem: Problem,
    curves: Sequence[Curve],
    marked: dict[str, Mark],
    table: Measurements,
) -> Plot:
    words, values = _QUANTITIES[what]
    series: list[Series] = []
    for curve in curves:
        y = np.maximum(values(curve), _LEAST)
        early, x, late = np.quantile(curve.seconds, (0.25, 0.5, 0.75), axis=0)
        how: Any = {"older": np.full(len(y), older(curve))}
        if against == "iterations":
            series.append(Series(curve.label, marked[curve.label], curve.iterations, y, **how))
        else:
            series.append(Series(curve.label, marked[curve.label], x, y, early, late, across=True, **how))
    lowest = min((float(np.nanmin(one.y)) for one in series if np.isfinite(one.y).any()), default=np.inf)
    shaded = what == "gap" and lowest < problem.round_off < np.inf
    doubt = [f"Reference not certified: {problem.doubt}."] if problem.doubt else []
    shares = ["Curves: median over the rounds, shaded between the quartiles."] if against == "time" else []
    return Plot(
        *(of, (what, against), f"{problem.name}, {GUESSES[of[-1]]}", ""),
        *(_AGAINST[against], Scale(words, "log", "power"), series),
        bands=[Band(0.0, problem.round_off, "round-off")] if shaded else [],
        notes=[*doubt, *shares, *_hollow(curves), *_ended(curves)],
        machine=", ".join(table.machine),
    )


def _hollow(measured: Iterable[Curve | WorkPoint]) -> list[str]:
    return [OLDER] if any(map(older, measured)) else []


def _ended(curves: Sequence[Curve]) -> list[str]:
    """Describe the curves that ended early, grouped by status."""
    by: dict[str, list[str]] = {}
    for curve in curves:
        if curve.status != "ok":
            by.setdefault(curve.status, []).append(curve.label)
    return [f"Ended early ({how}): {', '.join(labels)}." for how, labels in sorted(by.items())]


def times(folder: Path) -> list[Entry]:
    """Build panels of the time to each accuracy.

    There are panels for each mesh and initial guess, without set-up and with amortised set-up.
    """
    table = without_short(read(folder))
    marked = looks((curve.label, curve.solver) for curve in table.curves)
    plots: list[Plot] = []
    for mesh in dict.fromkeys((p.scene, p.size, p.mesh) for p in table.problems):
        sure = [c for c in table.curves if (c.problem.scene, c.problem.size) == mesh[:2] and not c.problem.doubt]
        for guess in GUESSES:
            here = [curve for curve in sure if curve.first_guess == guess]
            for steps in (None, *STEPS) if here else ():
                of, name = (mesh[0], str(mesh[1]), guess), ("alone" if steps is None else f"over-{steps}",)
                title = "the step alone" if steps is None else f"set-up over {count(steps)} step{'s'[: steps > 1]}"
                series = list(_reaching(here, marked, steps))
                x = Scale("energy gap to be reached", "names", names=tuple(map(power, TARGETS)))
                y = Scale("wall time, median over the steps of the mesh", "log", "time")
                problems = [p for p in table.problems if (p.scene, p.size) == mesh[:2]]
                plots.append(
                    Plot(
                        *(of, name, f"{mesh[2]}, {GUESSES[guess]}", title, x, y),
                        series,
                        notes=[*(f"{sentence}." for sentence in left_out(problems)), *_hollow(here)],
                        machine=", ".join(table.machine),
                    )
                )
    return ready(plots)


def _reaching(curves: Sequence[Curve], marked: dict[str, Mark], steps: int | None) -> Iterator[Series]:
    for label in dict.fromkeys(curve.label for curve in curves):
        own = [curve for curve in curves if curve.label == label]
        y = np.array([middle(own, target, steps) for target in TARGETS])
        y = np.where(np.isfinite(y) & (y > 0.0), y, np.nan)
        if np.isfinite(y).any():
            hollow = np.full(len(y), any(map(older, own)))
            yield Series(label, marked[label], np.arange(len(TARGETS), dtype=float), y, older=hollow)


def work(folder: Path) -> list[Entry]:
    """Build panels of error against wall time of whole simulations, for each mesh and integrator."""
    table = read(folder)
    known = [w for w in table.works if w.status == "ok" and 0.0 < w.error < np.inf and 0.0 < w.seconds < np.inf]
    marked = looks((work.label, work.solver) for work in table.works)
    plots: list[Plot] = []
    for mesh in dict.fromkeys((w.scene, w.size, w.mesh) for w in known):
        here = [w for w in known if (w.scene, w.size) == mesh[:2]]
        for integrator in dict.fromkeys(w.integrator for w in here):
            mine = [w for w in here if w.integrator == integrator]
            tolerances = sorted({w.tolerance for w in mine if w.tolerance is not None}, reverse=True)
            said = ["Joined points differ in the time step alone."]
            if len(tolerances) > 1:
                said.append(
                    f"Larger marks: tighter tolerances, {', '.join(power(t) if t else 'auto' for t in tolerances)}."
                )
            plots.append(
                Plot(
                    *((mesh[0], str(mesh[1])), (integrator,), f"{mesh[2]}, {quantity(mine[0].horizon)} s", integrator),
                    Scale("wall time a simulated second", "log", "time"),
                    Scale("error of the positions, relative to the way from the start", "log", "percent"),
                    [_front(here), *_chains(mine, marked, tolerances)],
                    notes=[
                        *(*said, "Grey: the least error that a budget buys, by any integrator."),
                        *(*by_self_converged(mine), *_hollow(mine)),
                    ],
                    machine=", ".join(table.machine),
                )
            )
    return ready(plots)


def _front(works: Sequence[WorkPoint]) -> Series:
    best = front(works)
    x, y = np.array([w.seconds for w in best]), np.array([w.error for w in best])
    return Series("best of all", Mark("#b9b6af", "None"), x, y, steps=True)


def _chains(works: Sequence[WorkPoint], marked: dict[str, Mark], tolerances: Sequence[float]) -> Iterator[Series]:
    chains: dict[tuple[str, float | None, int, str], list[WorkPoint]] = {}
    for one in works:
        chains.setdefault((one.label, one.tolerance, one.iterations, one.first_guess), []).append(one)
    for (label, tolerance, iterations, _), members in chains.items():
        members.sort(key=lambda one: one.time_step)
        x, y = np.array([one.seconds for one in members]), np.array([one.error for one in members])
        setting = stop_words(tolerance, iterations)
        grown = 1.0 + 0.25 * tolerances.index(tolerance) if tolerance in tolerances else 1.0
        hollow = np.array([older(one) for one in members])
        yield Series(label, marked[label], x, y, older=hollow, setting=setting, grown=grown)


def profiles(folder: Path) -> list[Entry]:
    """Build panels of performance and data profiles, one per accuracy."""
    table = without_short(read(folder))
    kinds = {
        "performance": ("time, over the fastest solver's", "performance profile", least_ratios),
        "data": (f"time, in iterations of {yardstick(table)}", "data profile", iteration_ratios),
    }
    marked = looks((curve.label, curve.solver) for curve in table.curves)
    plots: list[Plot] = []
    for kind, (words, subject, ratios) in kinds.items():
        for target in TARGETS if yardstick(table) or kind == "performance" else ():
            races = len(judged(table, target))
            found = {label: values for label, values in ratios(table, target).items() if np.isfinite(values).any()}
            if found and races:
                plots.append(
                    Plot(
                        *((kind,), (f"{target:.0e}".replace("e-0", "e-"),), subject),
                        *(f"to a gap of {power(target)}: {races} problems", Scale(words, "log", "plain")),
                        Scale("share of the problems solved", "linear", "percent"),
                        list(_stairs(found, marked)),
                        notes=[*not_shown(table), *by_other_code(table.curves)],
                        machine=", ".join(table.machine),
                    )
                )
    return ready(plots)


def _stairs(found: dict[str, Values], marked: dict[str, Mark]) -> Iterator[Series]:
    known = np.concatenate([values[np.isfinite(values)] for values in found.values()])
    low, high = known.min(initial=1.0), 2.0 * known.max(initial=5.0)
    for label, values in found.items():
        x = np.unique([low, *values[np.isfinite(values)], high])
        yield Series(label, marked[label], x, share(values, x), steps=True)


def growth(folder: Path) -> list[Entry]:
    """Build panels of time to a gap against the number of vertices.

    There is one for each scene and initial guess.
    """
    table = without_short(read(folder))
    marked = looks((curve.label, curve.solver) for curve in table.curves)
    found = [one for one in growths(table) if one.vertices]
    plots: list[Plot] = []
    for scene, guess in dict.fromkeys((one.scene, one.first_guess) for one in found):
        here = [one for one in found if (one.scene, one.first_guess) == (scene, guess)]
        series = [
            Series(
                one.label + (f" n^{one.exponent:.2f}" if np.isfinite(one.exponent) else ""),
                *(marked[one.label], np.array(one.vertices, float), np.array(one.seconds)),
                older=np.array(one.older),
            )
            for one in here
        ]
        lost = [f"Not reached by {g.label} at {', '.join(map(str, g.lost))} vertices." for g in here if g.lost]
        hollow = [OLDER] if any(any(g.older) for g in here) else []
        plots.append(
            Plot(
                *((scene, guess), ("growth",), f"{scene}, {GUESSES[guess]}", "", Scale("vertices", "sizes", "plain")),
                *(Scale(f"wall time to a gap of {power(TARGET)}", "log", "time"), series),
                notes=[*lost, *hollow],
                machine=", ".join(table.machine),
            )
        )
    return ready(plots)


def paper(folder: Path) -> list[Entry]:
    """Build panels of figures 2 and 3 of Liu et al. 2013 with own results."""
    from harness.report.accuracy.paper import comparisons, own

    table = read(folder)
    found = comparisons(table)
    plots: list[Plot] = []
    for curve in dict.fromkeys(one.curve for one in found):
        mine = [one for one in found if one.curve == curve]
        x = np.array([one.iterations for one in mine], float)
        ours, theirs = (np.array([getattr(one, side) for one in mine]) for side in ("ours", "theirs"))
        series = [Series("ours", Mark("#0072b2", "o"), x, ours)]
        series.append(Series("Liu et al. 2013", Mark(MUTED, "D", (0, (3, 1.5))), x, theirs))
        of = curve.replace("figure ", "figure-").replace(" × ", "x").replace(" = ", "").replace(", ", ":").split(":")
        plots.append(
            Plot(
                *((of[0],), tuple(of[1:]) or ("iterations",), curve, "", Scale("iterations", "log", "plain")),
                *(Scale("relative error (g − g*) / (g₀ − g*)", "log", "power"), series),
                notes=by_other_code(own(table)),
                machine=", ".join(table.machine),
            )
        )
    return ready(plots)
