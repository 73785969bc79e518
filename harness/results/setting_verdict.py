"""Verdict on given settings: whether substeps and iterations are converged, and which setting is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from math import ceil, inf, isfinite, log, log2
from typing import Any, NamedTuple

import numpy as np
from springbench.solvers.model.step_problem import Positions

ERROR_LEVELS = (0.05, 0.01)
"""Relative errors for which the cheapest setting is found."""


MAX_EXTRAPOLATION, MIN_ORDER = 16, 0.3
"""Largest factor of an extrapolation beyond the map, and the least order of convergence that permits one."""


class StepSetting(NamedTuple):
    """Substeps of a frame, and iterations in each; 0 iterations where a method has none."""

    substeps: int
    iterations: int

    def __str__(self) -> str:
        return f"{self.substeps} x {self.iterations}" if self.iterations else f"{self.substeps} substeps"

    @property
    def total_iterations(self) -> int:
        """Number of iterations of a frame."""
        return self.substeps * max(1, self.iterations)


class SettingChange(NamedTuple):
    """Change of the motion where substeps or iterations are multiplied by a factor."""

    factor: float
    change: float


@dataclass(frozen=True, slots=True)
class SettingAssessment:
    """Assessment of a given setting.

    Attributes:
        setting: the given setting.
        substep_change, iteration_change: change of the motion with at least twice the substeps or iterations; None
            where that was not simulated, or does not apply.
        effective_stiffness: ratio of the true sag to that of the setting; None where nothing sags.
    """

    setting: StepSetting
    substep_change: SettingChange | None = None
    iteration_change: SettingChange | None = None
    effective_stiffness: float | None = None

    @property
    def known_changes(self) -> dict[str, SettingChange]:
        """Known changes by what is multiplied."""
        named = {"substeps": self.substep_change, "iterations": self.iteration_change}
        return {name: change for name, change in named.items() if change is not None}


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
    positions: Positions = field(default_factory=lambda: np.empty((0, 0, 3)))

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of the table that is written."""
        numbers = {name: getattr(self, name) for name in ("error", "max_strain", "energy_drift", "frame_seconds")}
        values = {name: value if isfinite(value) else None for name, value in numbers.items()}
        return {
            "substeps": self.setting.substeps,
            "iterations": self.setting.iterations or None,
            **values,
            "reason": self.reason or None,
        }


class SettingDifference(NamedTuple):
    """Difference of the motions of two settings."""

    first: StepSetting
    second: StepSetting
    change: float


@dataclass(frozen=True, slots=True, eq=False)
class ConvergenceStudy:
    """Settings around given ones, with their errors.

    Attributes:
        solver: name of the solver or engine.
        error_requested: relative error that counts as converged.
        reference: what the errors are measured against, in words.
        results: result of each setting.
        assessments: assessment of each given setting, in the order in which they were given.
        largest_difference: largest difference of the motions of two given settings; None if fewer than two succeeded.
        min_error: smallest error that can be measured against the reference.
    """

    solver: str
    error_requested: float
    reference: str
    results: tuple[SettingResult, ...]
    assessments: tuple[SettingAssessment, ...]
    largest_difference: SettingDifference | None = None
    min_error: float = 0.0

    @property
    def given_settings(self) -> tuple[StepSetting, ...]:
        """The given settings."""
        return tuple(one.setting for one in self.assessments)

    def find_result(self, setting: StepSetting) -> SettingResult:
        """Return the result of a setting; KeyError if there is none."""
        return {result.setting: result for result in self.results}[setting]

    def find_cheapest(self, max_error: float) -> SettingResult | None:
        """Return the cheapest setting within a relative error; None if none is known."""
        within = [result for result in self.results if result.error <= max_error and max_error >= self.min_error]
        return min(within, key=lambda result: result.frame_seconds, default=None)

    def is_setting_converged(self, assessment: SettingAssessment) -> bool:
        """Return whether the error and the motion's changes are at most the requested error."""
        changes = [one.change for one in assessment.known_changes.values()]
        return max([self.find_result(assessment.setting).error, *changes]) <= self.error_requested

    @property
    def is_converged(self) -> bool:
        """Whether all given settings are converged."""
        return all(map(self.is_setting_converged, self.assessments))

    def predict_setting(self, max_error: float) -> StepSetting | None:
        """Predict a setting beyond the map that meets an error.

        The prediction extrapolates the finest row and column of the map, on the assumption that the error is
        proportional to a power of the number of substeps or iterations.

        Args:
            max_error: relative error.

        Returns:
            The cheaper one of more substeps and more iterations; None where errors fall too slowly to decide.
        """
        known = {result.setting: result.error for result in self.results if 0.0 < result.error < inf}
        if not known:
            return None
        finest = max(known, key=lambda setting: (setting.total_iterations, setting.substeps))
        found = list[StepSetting]()
        for name in ("substeps", "iterations"):
            number: int = getattr(finest, name)
            fewer = [
                one
                for one in known
                if one._replace(**{name: number}) == finest and 0 < 2 * getattr(one, name) <= number
            ]
            if not fewer:
                continue
            coarse = max(fewer)
            order = log(known[coarse] / known[finest]) / log(number / getattr(coarse, name))
            doublings = ceil(log2(known[finest] / max_error) / order) if order >= MIN_ORDER else inf
            if 0 < doublings <= log2(MAX_EXTRAPOLATION):
                found.append(finest._replace(**{name: number * 2 ** int(doublings)}))
        return min(found, key=lambda setting: setting.total_iterations, default=None)

    def describe_verdict(self) -> list[str]:
        """Describe the given settings and what to do, in sentences."""
        lines = self._describe_one(self.assessments[0]) if len(self.assessments) == 1 else self._describe_several()
        return lines + [self._describe_level(level) for level in sorted({*ERROR_LEVELS, self.error_requested})[::-1]]

    def _describe_one(self, assessment: SettingAssessment) -> list[str]:
        given = self.find_result(assessment.setting)
        if given.reason:
            return [f"{given.setting} failed: {given.reason}"]
        what = "" if not given.setting.iterations else " substeps x iterations"
        state = "converged" if self.is_setting_converged(assessment) else "not converged"
        lines = [
            f"{given.setting}{what}: {state} to {self._formatted_request}. "
            f"The error is {describe_percent(given.error)}, against {self.reference}.",
            f"The largest strain is {describe_percent(given.max_strain)}{_describe_drift(given.energy_drift)}.",
            *self._describe_changes(assessment),
        ]
        if assessment.effective_stiffness is not None:
            lines.append(_describe_stiffness(assessment.effective_stiffness))
        return lines

    def _describe_several(self) -> list[str]:
        """Describe several settings: how many are converged, each of them, and the nearest one."""
        good = [one for one in self.assessments if self.is_setting_converged(one)]
        nearest = min(self.assessments, key=lambda one: self.find_result(one.setting).error)
        count = f"{len(good)} of the {len(self.assessments)}" if good else f"None of the {len(self.assessments)}"
        lines = [f"{count} settings {'is' if len(good) < 2 else 'are'} converged to {self._formatted_request}."]
        error = self.find_result(nearest.setting).error
        if isfinite(error):
            lines[0] += f" {nearest.setting} is the nearest to {self.reference}, with an error of "
            lines[0] += f"{describe_percent(error)}."
        lines += [self._describe_row(one) for one in self.assessments]
        if apart := self.largest_difference:
            verb = "need not be valid" if apart.change > self.error_requested else "is valid to that error"
            lines.append(
                f"The motions of {apart.first} and {apart.second} differ by {describe_percent(apart.change)}: "
                f"what is found with one {verb} with the other."
            )
        if isfinite(error) and nearest not in good:
            lines += [f"{nearest.setting}: {one[0].lower()}{one[1:]}" for one in self._describe_changes(nearest)]
        return lines

    def _describe_row(self, assessment: SettingAssessment) -> str:
        given = self.find_result(assessment.setting)
        if given.reason:
            return f"{given.setting} failed: {given.reason}."
        parts = [f"error {describe_percent(given.error)}", f"largest strain {describe_percent(given.max_strain)}"]
        if assessment.effective_stiffness is not None:
            parts.append(f"hangs as if {assessment.effective_stiffness:.2g} times as stiff")
        return f"{given.setting}: {', '.join(parts)}."

    @property
    def _formatted_request(self) -> str:
        return describe_percent(self.error_requested)

    def _describe_changes(self, assessment: SettingAssessment) -> list[str]:
        lines = list[str]()
        for what, (factor, change) in assessment.known_changes.items():
            still = (
                "which is more than the required error"
                if change > self.error_requested
                else "less than the required error"
            )
            times = "Twice" if factor == 2.0 else f"{factor:.3g} times"
            lines.append(f"{times} the {what} change the motion by {describe_percent(change)}, {still}.")
        return lines

    def _describe_level(self, level: float) -> str:
        within = f"Within {describe_percent(level)}"
        if level < self.min_error:
            smallest = describe_percent(self.min_error)
            return f"{within}: unknown, because the reference resolves only errors above {smallest}."
        best = self.find_cheapest(level)
        if best is None:
            nearest = min(self.results, key=lambda result: result.error)
            if not isfinite(nearest.error):
                return f"{within}: no setting of the map; all failed."
            found = f"{within}: no setting of the map; the nearest is {nearest.setting}, with "
            found += describe_percent(nearest.error)
            if predicted := self.predict_setting(level):
                return f"{found}. By the trend about {predicted} would be within."
            return f"{found}. Errors fall too slowly along the map to predict one that is."
        cost = f"{1e3 * best.frame_seconds:.3g} ms a frame"
        if len(self.given_settings) == 1 and isfinite(own := self.find_result(self.given_settings[0]).frame_seconds):
            cost += (
                f", {best.frame_seconds / own:.2g} times the given" if best.setting != self.given_settings[0] else ""
            )
        return f"{within}: {best.setting} is the cheapest, {cost}."


def list_settings(given: Sequence[StepSetting], num_doublings: int) -> list[StepSetting]:
    """Return the settings around given ones, the cheapest first.

    They combine all given numbers, and those by powers of two below the smallest and above the largest.

    Args:
        given: given settings.
        num_doublings: how often the numbers are halved and doubled.
    """
    substeps, iterations = (_extend_numbers(numbers, num_doublings) for numbers in zip(*given, strict=True))
    found = [StepSetting(s, i) for s in substeps for i in iterations]
    return sorted(found, key=lambda setting: (setting.total_iterations, setting))


def find_doubled(settings: Iterable[StepSetting], given: StepSetting, name: str) -> StepSetting | None:
    """Find a setting with one number at least doubled, and the other equal.

    Args:
        settings: settings of a map.
        given: given setting.
        name: `substeps` or `iterations`.

    Returns:
        The one with the smallest such number; None if there is none.
    """
    number: int = getattr(given, name)
    more = [one for one in settings if getattr(one, name) >= 2 * number > 0 and one._replace(**{name: number}) == given]
    return min(more, default=None)


def find_largest_difference(
    results: Sequence[SettingResult], measure: Callable[[Positions, Positions], float]
) -> SettingDifference | None:
    """Return the two settings whose motions differ most; None if fewer than two succeeded.

    Args:
        results: results of settings.
        measure: relative difference of two motions (k, n, 3) [m].
    """
    pairs = combinations([result for result in results if not result.reason], 2)
    found = [SettingDifference(a.setting, b.setting, measure(a.positions, b.positions)) for a, b in pairs]
    return max(found, key=lambda one: one.change, default=None)


MAX_SETTING = 1_000_000
"""Largest number of substeps, and of iterations."""


def parse_setting(text: str) -> StepSetting:
    """Parse a setting such as 2x5, or 8 for substeps alone.

    Raises:
        ValueError: if the text is no setting, or a number exceeds MAX_SETTING.
    """
    substeps, cross, iterations = text.lower().replace("×", "x").replace(" ", "").partition("x")
    found = StepSetting(int(substeps), int(iterations) if cross else 0)
    if not 1 <= found.substeps <= MAX_SETTING or (cross and not 1 <= found.iterations <= MAX_SETTING):
        raise ValueError(text)
    return found


def _extend_numbers(numbers: Iterable[int], num_doublings: int) -> list[int]:
    """Extend numbers by halving the smallest and doubling the largest repeatedly; 0 is not extended."""
    known = set(numbers)
    if 0 in known:
        return [0]
    factors = [2**k for k in range(1, num_doublings + 1)]
    fewer = {max(1, round(min(known) / factor)) for factor in factors}
    return sorted(known | fewer | {max(known) * factor for factor in factors})


SIMILAR_STIFFNESS = 0.02
"""Relative difference of the sag below which the effective stiffness counts as correct."""


def describe_percent(value: float) -> str:
    """Format a share in percent; "unknown" if it is not finite."""
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
