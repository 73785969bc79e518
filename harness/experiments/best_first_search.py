"""Best-first search for the cheapest method that meets an error.

`springbench recommend` and `springbench run --error` use it. A candidate is a method. It proposes one setting after the
other, a step size or a tolerance, with its expected cost. The candidate with the smallest expected cost is tried next,
and receives the error and the cost of the trial before it proposes again. It is given up once its expected cost exceeds
a multiple of the best cost known, which is also the limit of each trial. A trial that exceeds the limit may be repeated
with a larger one after all others, while nothing meets the error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass, replace
from heapq import heapify, heappop, heappush
from math import inf
from time import monotonic
from typing import Generic, TypeVar

Setting = TypeVar("Setting")
Result = TypeVar("Result")

OUT_OF_TIME = "the time for the search was used up"


@dataclass(frozen=True, slots=True)
class TrialOutcome(Generic[Result]):
    """Error and cost of a method at one setting.

    Attributes:
        error: relative error; infinite where it is unknown.
        cost: time, in the unit of the search; infinite where there is no result.
        is_late: whether it was ended by its limit.
        is_slow: whether it was ended by its limit, or costs more than the give-up rule permits; set by the search.
        limits_others: whether its cost limits that of others, if it meets the error.
        result: what was computed.
    """

    error: float = inf
    cost: float = inf
    is_late: bool = False
    is_slow: bool = False
    limits_others: bool = True
    result: Result | None = None


@dataclass(frozen=True, slots=True)
class SettingProposal(Generic[Setting]):
    """Setting that a candidate proposes to try.

    Attributes:
        setting: the setting.
        expected_cost: lower bound or prediction of the cost of what meets the error.
        initial_limit: limit of the cost while no cost is known that limits it.
        attempt: number of trials at this setting that exceeded their limits.
        num_remaining: number of settings that are omitted if the candidate is given up.
    """

    setting: Setting
    expected_cost: float = 0.0
    initial_limit: float = inf
    attempt: int = 0
    num_remaining: int = 1


SettingProposals = Generator[SettingProposal[Setting], TrialOutcome[Result], TrialOutcome[Result] | None]
"""Generator of a candidate's settings: receives the outcome of each trial, and returns its final outcome, if any."""


@dataclass(frozen=True, slots=True)
class GiveUpRule:
    """Rule by which a candidate is given up because of its cost.

    Attributes:
        max_cost_ratio: multiple of the best cost.
        min_limit: smallest limit of a trial, so that a short interruption does not exclude a candidate.
        reason: the reason, for the summary.
    """

    max_cost_ratio: float
    min_limit: float
    reason: str = "they cost too much"

    def is_exceeded(self, cost: float, best_cost: float) -> bool:
        """Return whether a cost is too large for a best cost.

        Args:
            cost: expected or measured cost, in the unit of the search.
            best_cost: smallest cost so far that meets the error; infinite without one.
        """
        return cost > self.max_cost_ratio * best_cost

    def compute_limit(self, proposal: SettingProposal[Setting], best_cost: float) -> float:
        """Return the limit of the cost of a trial.

        Args:
            proposal: setting to try, with its limit for the case that no best cost is known.
            best_cost: smallest cost so far that meets the error, in the unit of the search; infinite without one.
        """
        return proposal.initial_limit if best_cost == inf else max(self.min_limit, self.max_cost_ratio * best_cost)


@dataclass(frozen=True, slots=True)
class SearchSummary(Generic[Result]):
    """Summary of a search.

    Attributes:
        num_trials: number of settings that were tried or known.
        reasons: number of omitted settings by reason.
        answer: the outcome at which the search ended, where it ends at the first one that meets the error.
    """

    num_trials: int
    reasons: Mapping[str, int]
    answer: TrialOutcome[Result] | None = None

    @property
    def is_complete(self) -> bool:
        """Whether the search ended within its time."""
        return OUT_OF_TIME not in self.reasons

    def __str__(self) -> str:
        reasons = "".join(f"; {count} not: {reason}" for reason, count in self.reasons.items())
        return f"{self.num_trials} of {self.num_trials + sum(self.reasons.values())} settings measured{reasons}"


def search_best_first(
    candidates: Iterable[tuple[float, SettingProposals[Setting, Result]]],
    run_trial: Callable[[Setting, float], TrialOutcome[Result]],
    max_error: float,
    rule: GiveUpRule,
    *,
    best_cost: float = inf,
    search_time: float = inf,
    omitted: Counter[str] | None = None,
    ends_at_answer: bool = False,
) -> SearchSummary[Result]:
    """Try settings until no candidate can be the cheapest that meets an error.

    Args:
        candidates: expected cost and settings of each method.
        run_trial: runs a method at a setting within a limit of the cost.
        max_error: relative error to meet.
        rule: when a candidate is given up.
        best_cost: cost of the best known setting, infinite without one.
        search_time: wall time after which no trial starts [s].
        omitted: number of settings by the reasons for which candidates omit them; more are added.
        ends_at_answer: whether the search ends at the first candidate whose final outcome meets the error.

    Returns:
        The numbers of trials and of omitted settings, and the outcome at which the search ended.
    """
    omitted = Counter[str]() if omitted is None else omitted
    num_trials, has_answer, deadline = 0, best_cost < inf, monotonic() + search_time
    every = list(candidates)
    # Ordered by attempts, then expected cost; the unique index prevents a comparison of proposals.
    waiting: list[tuple[int, float, int, SettingProposal[Setting] | None]] = [
        (0, cost, number, None) for number, (cost, _) in enumerate(every)
    ]
    heapify(waiting)
    while waiting:
        _, expected_cost, number, proposal = heappop(waiting)
        settings = every[number][1]
        try:
            proposal = proposal or next(settings)
            too_dear = rule.is_exceeded(expected_cost, best_cost) or (proposal.attempt and has_answer)
            if too_dear or monotonic() > deadline:
                omitted[rule.reason if too_dear else OUT_OF_TIME] += proposal.num_remaining
                continue
            outcome = run_trial(proposal.setting, rule.compute_limit(proposal, best_cost))
            num_trials += 1
            if outcome.error <= max_error and outcome.cost < inf:
                has_answer = True
                best_cost = min(best_cost, outcome.cost) if outcome.limits_others else best_cost
            is_slow = outcome.is_late or (outcome.cost < inf and rule.is_exceeded(outcome.cost, best_cost))
            proposal = settings.send(replace(outcome, is_slow=is_slow))
        except StopIteration as ended:
            answer: TrialOutcome[Result] | None = ended.value
            if ends_at_answer and answer and answer.error <= max_error:
                return SearchSummary(num_trials, _drop_zeros(omitted), answer)
            continue
        heappush(waiting, (proposal.attempt, proposal.expected_cost, number, proposal))
    return SearchSummary(num_trials, _drop_zeros(omitted))


def _drop_zeros(omitted: Counter[str]) -> dict[str, int]:
    return {reason: count for reason, count in omitted.items() if count}
