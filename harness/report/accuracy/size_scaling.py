"""Scaling with size: time to a gap of 1e-3 against the number of vertices.

Power laws are fitted to these times.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from springbench.harness.report.accuracy.accuracy_data import AccuracyData, ConvergenceCurve
from springbench.harness.report.accuracy.time_to_accuracy import compute_median_time
from springbench.harness.report.provenance_words import is_stale

GAP_TARGET = 1e-3

_MIN_FIT_SIZES = 3
"""Number of sizes that a fit needs."""


class SizeScaling(NamedTuple):
    """A solver's times to GAP_TARGET by size, where it reached the gap.

    Attributes:
        vertices: numbers of vertices (k,).
        seconds: median over the snapshots (k,) [s].
        exponent: exponent of the fitted power law; nan for too few sizes.
        unsolved_sizes: numbers of vertices of the sizes on which the gap was not reached.
        stale: which of the sizes (k,) involve measurements by other code than `newest_fingerprint`.
    """

    scene: str
    initial_guess: str
    label: str
    vertices: list[int]
    seconds: list[float]
    exponent: float
    unsolved_sizes: list[int]
    stale: list[bool]


def fit_scalings(table: AccuracyData, newest_fingerprint: str | None = None) -> list[SizeScaling]:
    """Fit the scaling of each solver on each scene with two sizes or more.

    Args:
        table: data of an accuracy measurement.
        newest_fingerprint: code that curves are compared with; None for the current version.
    """
    groups: dict[tuple[str, str, str], dict[int, list[ConvergenceCurve]]] = {}
    for curve in table.curves:
        sizes = groups.setdefault((curve.problem.scene, curve.initial_guess, curve.label), {})
        sizes.setdefault(curve.problem.vertices, []).append(curve)
    found: list[SizeScaling] = []
    for (scene, guess, label), sizes in groups.items():
        times = {n: compute_median_time(curves, GAP_TARGET) for n, curves in sorted(sizes.items())}
        reached = {n: t for n, t in times.items() if np.isfinite(t) and t > 0.0}
        if len(times) > 1:
            lost = [n for n, t in times.items() if t == np.inf]
            hollow = [any(is_stale(one.source_fingerprint, newest_fingerprint) for one in sizes[n]) for n in reached]
            exponent = fit_size_exponent(reached)
            found.append(SizeScaling(scene, guess, label, [*reached], [*reached.values()], exponent, lost, hollow))
    return found


def fit_size_exponent(times: Mapping[int, float]) -> float:
    """Fit the exponent of a power law; nan for too few sizes.

    Args:
        times: time by number of vertices.
    """
    if len(times) < _MIN_FIT_SIZES:
        return np.nan
    return float(np.polyfit(np.log([*times]), np.log([*times.values()]), 1)[0])
