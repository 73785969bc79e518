"""The search for the cheapest method for an error, on methods with formulas of errors and costs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil, inf
from pathlib import Path as File
from typing import ClassVar

import numpy as np
import pytest
from springbench.harness.config.config_loader import load_scene
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.error_control.candidate_methods import ErrorTarget, Method
from springbench.harness.experiments.error_control.method_search import search_cheapest_method
from springbench.harness.experiments.error_control.method_trials import SearchResult, Trial
from springbench.harness.reference.perturbation_growth import estimate_growth
from springbench.harness.simulation.adaptive_stepping import StepObserver, Stepper, TimeBudgetExceeded, Trajectory

SPRING = load_scene(File(__file__).parents[2] / "configs" / "scenes" / "single-spring.yaml")
STEPS = 10
"""The fewest."""


@dataclass(frozen=True)
class Formula(Stepper):
    """Its free vertex ends at (1 + error(steps), 0, 0); seconds: of processor time a step; wall time is twice that."""

    error: Callable[[int], float]
    seconds: float
    stated: int = 2
    has_fixed_step: ClassVar[bool] = True

    @property
    def order(self) -> int:
        return self.stated

    def integrate_motion(
        self, setting: float, *, cpu_limit: float = inf, observe: StepObserver | None = None
    ) -> Trajectory:
        steps = ceil(STEPS * setting)
        if (took := steps * self.seconds) > cpu_limit:
            raise TimeBudgetExceeded
        positions = np.zeros((2, 2, 3))
        positions[1, :, 0] = 1.0 + self.error(steps)
        return Trajectory(
            positions, np.zeros_like(positions), steps, 0, 0, steps, (1.0, 1.0), 2.0 * took, (2.0 * took,), took
        )


class Tolerant(Formula):
    """Its setting is a tolerance, from which the steps follow; it is never too slow."""

    has_fixed_step: ClassVar[bool] = False

    def integrate_motion(
        self, setting: float, *, cpu_limit: float = inf, observe: StepObserver | None = None
    ) -> Trajectory:
        return super().integrate_motion(max(1.0, setting ** (-1.0 / (self.order + 1.0))))


def search_followers(
    monkeypatch: pytest.MonkeyPatch, error: float, messages: list[str], **followers: Stepper
) -> SearchResult:
    """The result among methods of these names, the last of which measures the errors of all."""
    exact = Tolerant(lambda steps: 5.0 * steps**-4.0, 0.5, 4)
    named = [Method("substepping", name, one) for name, one in {**followers, "exact": exact}.items()]
    monkeypatch.setattr(
        "springbench.harness.experiments.error_control.method_search.prepare_candidate_methods", lambda *_: named
    )
    error_target = ErrorTarget.from_scene(SPRING, 2, 0.2)
    return search_cheapest_method(error_target, error, estimate_growth(SPRING, 2, 0.2), messages.append)


def test_the_order_is_measured_and_the_cost_predicted_by_it(monkeypatch):
    """Of order 1 though it states 2, a way costs the ratio of the errors, and not its square root."""
    first = Formula(lambda steps: 2.0 / steps, 1e-3)
    second = Formula(lambda steps: 20.0 / steps**2, 1e-2)
    answer = search_followers(monkeypatch, 1e-3, [], first=first, second=second)
    by_name = {one.method.solver: (one, promise) for one, promise in answer.trials}
    assert by_name["first"][0].order == pytest.approx(1.0, abs=0.05)
    assert by_name["second"][0].order == pytest.approx(2.0, abs=0.05)
    # DOUBT times the error, at AIM for steps of one length: 2.5/N = 0.85e-3 and 25/N^2 = 0.85e-3.
    assert by_name["first"][1] == pytest.approx(2941 * 1e-3, rel=0.1)
    assert by_name["second"][1] == pytest.approx(171 * 1e-2, rel=0.1)


def test_candidate_methods_are_sorted_chosen_and_printed_by_one_statistic(monkeypatch):
    messages = list[str]()
    ways = {f"w{k}": Formula(lambda steps: 1.0 / steps**2, 1e-3 * cost) for k, cost in enumerate((3.0, 1.0, 2.0))}
    answer = search_followers(monkeypatch, 1e-2, messages, **ways)
    promises = [promise for _, promise in answer.trials]
    assert promises == sorted(promises)
    assert answer.best_trial.method is answer.trials[0][0].method
    assert answer.best_trial.method.solver == "w1"
    printed = [line.split(": ")[1].split(" s ")[0] for line in messages if " predicted; " in line]
    assert printed == [f"{promise:.3g}" for promise in promises]


def test_a_method_that_does_not_improve_is_followed_by_the_next(monkeypatch):
    messages = list[str]()
    stuck = Formula(lambda steps: 0.03 + 1.0 / steps**2, 1e-4)
    answer = search_followers(monkeypatch, 1e-2, messages, stuck=stuck, slower=Formula(lambda steps: 1.0 / steps, 1e-2))
    assert answer.best_trial.method.solver != "stuck"
    assert answer.best_trial.error_estimated <= 1e-2
    assert any(line.startswith("  stuck: reaches an error of 3.") and "do not reduce" in line for line in messages)


def test_a_method_that_takes_longer_than_predicted_for_the_next_is_tried_after_it(monkeypatch):
    """Its error falls as predicted at first, and then by order a half alone."""
    messages = list[str]()
    late = Formula(lambda steps: 20.0 / steps**2 if steps < 40 else 0.0125 * (40 / steps) ** 0.5, 1e-4)
    answer = search_followers(monkeypatch, 1e-3, messages, late=late, steady=Formula(lambda steps: 1.0 / steps, 3e-4))
    assert answer.trials[0][0].method.solver == "late"
    assert answer.best_trial.method.solver == "steady"
    assert any(line.startswith("  late: takes more than") for line in messages)


def test_an_error_that_no_method_reaches_is_refused_with_the_nearest(monkeypatch):
    lows = {"a": 0.3, "b": 0.2}
    named = [
        Method("substepping", k, Formula(lambda steps, low=low: low + 1.0 / steps**2, 1e-3)) for k, low in lows.items()
    ]
    monkeypatch.setattr(
        "springbench.harness.experiments.error_control.method_search.prepare_candidate_methods", lambda *_: named
    )
    monkeypatch.setattr(
        "springbench.harness.experiments.error_control.method_search._MethodSearch._find_reference_trial",
        lambda *_: _build_exact_trial(),
    )
    with pytest.raises(RunFailed, match=r"no step size reaches an error of 0.01: b was closest with 0\.3"):
        search_cheapest_method(
            ErrorTarget.from_scene(SPRING, 2, 0.2), 1e-2, estimate_growth(SPRING, 2, 0.2), lambda line: None
        )


def _build_exact_trial() -> Trial:
    follower = Formula(lambda steps: 0.0, 1e-3)
    return Trial(Method("substepping", "truth", follower), 1.0, follower.integrate_motion(1.0), 0.0, 2)
