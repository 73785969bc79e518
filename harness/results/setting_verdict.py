"""Verdict on a given setting: whether substeps and iterations are converged, and which setting would be."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

ERROR_LEVELS = (0.05, 0.01)
"""Relative errors for which the cheapest setting is found."""


class StepSetting(NamedTuple):
    """Substeps of a frame, and iterations in each."""

    substeps: int
    iterations: int

    def __str__(self) -> str:
        return f"{self.substeps} x {self.iterations}"


@dataclass(frozen=True, slots=True, eq=False)
class SettingResult:
    """Result of one setting.

    Attributes:
      setting: substeps and iterations.
      error: relative error over the whole motion; infinite where it failed or is the reference itself.
      max_strain: largest strain of a spring after any frame.
      energy_drift: energy at the end, minus that of the reference, over its largest kinetic energy.
      frame_seconds: median processor time of a frame [s].
      reason: why it failed; empty otherwise.
      positions: sampled positions (k, n, 3) [m]; empty where it failed.
    """

    setting: StepSetting
    error: float = inf
    max_strain: float = inf
    energy_drift: float = inf
    frame_seconds: float = inf
    reason: str = ""
    positions: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0, 3)))

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of the table that is written."""
        numbers = {name: getattr(self, name) for name in ("error", "max_strain", "energy_drift", "frame_seconds")}
        values = {name: value if isfinite(value) else None for name, value in numbers.items()}
        return {**self.setting._asdict(), **values, "reason": self.reason or None}


@dataclass(frozen=True, slots=True, eq=False)
class ConvergenceStudy:
    """Settings around a given one, with their errors.

    Attributes:
      solver: name of the solver or engine.
      given: the given setting.
      error_requested: relative error that counts as converged.
      reference: what the errors are measured against, in words.
      results: result of each setting.
      substep_change, iteration_change: change of the motion where substeps or iterations are doubled; None where that
        was not simulated, or does not apply.
      effective_stiffness: ratio of the true sag to that of the given setting; None where nothing sags.
    """

    solver: str
    given: StepSetting
    error_requested: float
    reference: str
    results: tuple[SettingResult, ...]
    substep_change: float | None
    iteration_change: float | None
    effective_stiffness: float | None

    def find_result(self, setting: StepSetting) -> SettingResult:
        """Return the result of a setting; KeyError if there is none."""
        return {result.setting: result for result in self.results}[setting]

    def find_cheapest(self, max_error: float) -> SettingResult | None:
        """Return the cheapest setting within a relative error; None if there is none."""
        within = [result for result in self.results if result.error <= max_error]
        return min(within, key=lambda result: result.frame_seconds, default=None)

    @property
    def is_converged(self) -> bool:
        """Whether the error, and the changes by doubling, are at most what is requested."""
        changes = [change for change in (self.substep_change, self.iteration_change) if change is not None]
        return max([self.find_result(self.given).error, *changes]) <= self.error_requested

    def describe_verdict(self) -> list[str]:
        """Describe the given setting and what to do, in sentences."""
        given, names = self.find_result(self.given), {"substeps": self.substep_change}
        if any(result.setting.iterations != self.given.iterations for result in self.results):
            names["iterations"] = self.iteration_change
        asked = f"{100 * self.error_requested:.3g} %"
        if given.reason:
            lines = [f"{self.given} failed: {given.reason}"]
        else:
            state = "converged" if self.is_converged else "not converged"
            lines = [
                f"{self.given} substeps x iterations is {state} to {asked}: "
                f"its error is {describe_percent(given.error)}, against {self.reference}.",
                f"Its largest strain is {describe_percent(given.max_strain)}{_describe_drift(given.energy_drift)}.",
            ]
        for what, change in names.items():
            if change is not None:
                still = "which is more than is asked" if change > self.error_requested else "less than is asked"
                lines.append(f"Twice the {what} change the motion by {describe_percent(change)}, {still}.")
        if self.effective_stiffness is not None:
            lines.append(_describe_stiffness(self.effective_stiffness))
        return lines + [self._describe_level(level) for level in sorted({*ERROR_LEVELS, self.error_requested})[::-1]]

    def _describe_level(self, level: float) -> str:
        best, given = self.find_cheapest(level), self.find_result(self.given)
        if best is None:
            nearest = min(self.results, key=lambda result: result.error)
            found = f"the nearest is {nearest.setting}, with {describe_percent(nearest.error)}"
            found = found if isfinite(nearest.error) else "all failed"
            return f"Within {100 * level:.3g} %: no setting of the map; {found}."
        cost = f"{1e3 * best.frame_seconds:.3g} ms a frame"
        if isfinite(given.frame_seconds) and best.setting != self.given:
            cost += f", {best.frame_seconds / given.frame_seconds:.2g} times the given"
        return f"Within {100 * level:.3g} %: {best.setting} is the cheapest, {cost}."


def list_settings(given: StepSetting, num_doublings: int, *, has_iterations: bool) -> list[StepSetting]:
    """Return the settings around a given one, by powers of two of each number, the cheapest first."""
    factors = [2.0**k for k in range(-num_doublings, num_doublings + 1)]
    substeps = sorted({max(1, round(given.substeps * factor)) for factor in factors})
    iterations = sorted(
        {max(1, round(given.iterations * factor)) for factor in factors if has_iterations or factor == 1}
    )
    found = [StepSetting(s, i) for s in substeps for i in iterations]
    return sorted(found, key=lambda setting: (setting.substeps * setting.iterations, setting))


SIMILAR_STIFFNESS = 0.02
"""Relative difference of the sag below which the material seems as stiff as it is."""


def describe_percent(value: float) -> str:
    """Describe a share in percent, or as unknown."""
    return f"{100 * value:.3g} %" if isfinite(value) else "unknown"


def _describe_drift(drift: float) -> str:
    if not isfinite(drift):
        return ""
    more = "more" if drift > 0.0 else "less"
    return f"; its energy at the end is {describe_percent(abs(drift))} of the largest kinetic energy {more} than true"


def _describe_stiffness(ratio: float) -> str:
    if abs(ratio - 1.0) <= SIMILAR_STIFFNESS:
        return "Hung up until it rests, the material sags as it should: the setting errs in motion only."
    return f"Hung up until it rests, the material sags as if it were {ratio:.3g} times as stiff as it is."
