"""Find the cheapest method for an error.

All methods are run, then the setting of the best one is tuned.

    estimate = |p(T) - q(T)| / |q(T) - p(0)|,    q: reference trial of a much smaller error

in Frobenius norms over the free vertices. The cost of a method depends on its error through its order: the step size is
proportional to error^(1/order). The order is measured where two settings were run, for a scene may reduce it. Methods
are compared by CPU seconds, including preparation.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from math import inf, log, sqrt
from pathlib import Path
from time import perf_counter

import numpy as np
from springbench.harness.config.sweep_config import SolverSpec
from springbench.harness.errors import RunFailed
from springbench.harness.experiments.best_first_search import (
    GiveUpRule,
    SettingProposal,
    SettingProposals,
    TrialOutcome,
    search_best_first,
)
from springbench.harness.experiments.error_control.candidate_methods import (
    ErrorTarget,
    Method,
    prepare_candidate_methods,
)
from springbench.harness.experiments.error_control.method_trials import SearchResult, Trial
from springbench.harness.reference.perturbation_growth import PerturbationGrowth, estimate_growth
from springbench.harness.reference.reference_trajectory import ReferenceTrajectory, compute_position_error
from springbench.harness.simulation.adaptive_stepping import StepSizeUnderflow, TimeBudgetExceeded, Trajectory
from springbench.harness.simulation.fixed_stepping import FixedImplicitStepper
from springbench.harness.simulation.time_loop import build_initial_state
from springbench.solvers.methods.newton.newton_direct import NewtonSolver
from springbench.solvers.model.step_problem import Positions

ERROR_AIM = 0.65
"""Fraction of the target error at which a setting aims, because estimates scatter."""
_ERROR_AIM_FIXED_STEPS = 0.85
"""ERROR_AIM for fixed step sizes, whose error follows their order."""
MIN_ERROR_FRACTION = 1 / 3
"""Smallest fraction of the target error that is accepted if a cheaper setting is stable.

Estimated errors are compared with ESTIMATE_SAFETY times this fraction.
"""
REFERENCE_ERROR_FRACTION = 1 / 50
"""Local error of the reference trial, as a fraction of that of the trial."""
ESTIMATE_SAFETY = 1.25
"""Safety factor on error estimates, because the reference trial has an error too.

That error is a tenth of the estimate. It is a sixth where stability limits the step size, so that the reference trial
has hardly shorter steps.
"""
_MIN_REFERENCE_REFINEMENT = 10.0
"""Factor of accuracy, by order and number of steps, above which a trial may serve as reference."""
_MAX_SETTING_CHANGES, _MAX_STALLS, _MAX_REFERENCE_TRIALS = 6, 2, 3
_MIN_TIMED_SECONDS = 0.05
"""CPU time below which a trial is run twice, and the smaller time counts [s]."""
_INITIAL_TIME_LIMIT, _TIME_LIMIT_GROWTH = 1.0, 4.0
"""Time limit of a method until one has finished [s of CPU time], and its growth if none has."""
_MIN_TIME_LIMIT, _TIME_LIMIT_FACTOR = 0.01, 3.0
"""Smallest time limit of the other methods [s of CPU time], a few interruptions; its ratio to the cheapest time."""
_MAX_COST_RATIO = 2.0
"""Factor on the predicted cost of the next method, above which that method is tried first."""
_MIN_ORDER = 0.5
"""Lower bound of measured orders; a method whose error decreases more slowly is given up."""


def compute_predictability_horizon(
    error_target: ErrorTarget, max_error: float, print_message: Callable[[str], None]
) -> PerturbationGrowth:
    """Compute how far ahead the motion is predictable.

    The smallest error that can be reached is printed.

    Args:
        error_target: the scene and its end time.
        max_error: relative error to reach.
        print_message: prints a remark.

    Raises:
        UnpredictableMotion: the error cannot be reached at t_end (the message states one that can), or nothing moves.
    """
    seen = estimate_growth(error_target.scene, error_target.size, error_target.t_end)
    seen.require_predictable(max_error)
    print_message(
        f"a perturbation of 1e-12 of the size grows to {seen.growth_factor[-1]:.1e} of the displacement after "
        f"{error_target.t_end:g} s: an error of {max_error:g} can be reached "
        f"there, and of at least {seen.min_error:.0e}"
    )
    return seen


def search_cheapest_method(
    error_target: ErrorTarget,
    max_error: float,
    growth: PerturbationGrowth,
    print_message: Callable[[str], None],
    candidates: Sequence[tuple[str, SolverSpec]] = (),
    reference: ReferenceTrajectory | None = None,
) -> SearchResult:
    """Find the cheapest method whose relative error at t_end is at most `max_error`.

    Args:
        error_target: the scene and its end time.
        max_error: relative error to reach.
        growth: growth of perturbations (`compute_predictability_horizon`).
        print_message: prints a remark.
        candidates: integrators and solvers to try; the default candidates if empty.
        reference: motion at t_end that errors are measured by; a trial with a much smaller error if omitted.

    Raises:
        RunFailed: no method reaches the error.
    """
    return _MethodSearch(error_target, max_error, growth, print_message, reference).find_cheapest(candidates)


def search_cheapest_contact_method(
    error_target: ErrorTarget,
    max_error: float,
    results: Path,
    print_message: Callable[[str], None],
    report_trial: Callable[[str], None],
    candidates: Sequence[tuple[str, SolverSpec]],
) -> SearchResult:
    """Find the cheapest method for a scene with contact, whose errors a self-converged reference measures.

    Args:
        error_target: the scene and its end time.
        max_error: relative error to reach.
        results: folder of results, with the stored references.
        print_message: prints a remark on the reference.
        report_trial: prints a remark on the search.
        candidates: integrators and solvers to try.

    Raises:
        RunFailed: no method reaches the error, or the reference does not resolve it at the end time.
    """
    from springbench.harness.experiments.accuracy.accuracy_units import open_reference_store  # only with contact

    reference = open_reference_store(results).require_contact_horizon(
        error_target.scene, error_target.size, error_target.t_end, error=max_error
    )
    print_message(f"the reference has an error of up to {reference.get_error_bound(-1):.1e}, which estimates include")
    growth = PerturbationGrowth.from_reference(reference)
    return search_cheapest_method(error_target, max_error, growth, report_trial, candidates, reference)


_MethodSetting = tuple[Method, float]


class _MethodSearch:
    """Search for the cheapest method of one target."""

    def __init__(
        self,
        error_target: ErrorTarget,
        error: float,
        growth: PerturbationGrowth,
        print_message: Callable[[str], None],
        reference: ReferenceTrajectory | None,
    ) -> None:
        self._reference = reference
        self._error_target, self._max_error, self._growth, self._print_message = (
            error_target,
            error,
            growth,
            print_message,
        )
        self._underflows = list[StepSizeUnderflow]()
        self._free_vertices = error_target.build_scene(error_target.frame_seconds, "substepping").system.free_vertices

    def find_cheapest(self, candidates: Sequence[tuple[str, SolverSpec]]) -> SearchResult:
        self._print_message("methods for the error:")
        tolerance = 0.2 * self._max_error * self._growth.scale
        known = prepare_candidate_methods(self._error_target, self._print_message, candidates)
        began = perf_counter()
        raced = self._run_first_trials(known, tolerance)
        closer = (
            self._find_reference_trial(raced) if self._reference is None else self._adopt_reference(self._reference)
        )
        graded = sorted((self._estimate_error_and_order(one, closer) for one in raced), key=self._predict_cost)
        for one in graded:
            self._print_message(
                f"  {one.method}: {self._predict_cost(one):.3g} s predicted; "
                f"{one.trajectory.cpu_seconds:.3g} s for an error of "
                f"{one.error_estimated:.1e}, of order {one.order:.2g}"
            )
        best, note = self._find_first_reaching(graded, closer)
        besides = perf_counter() - began - best.trajectory.wall_seconds
        predicted = tuple((one, self._predict_cost(one)) for one in graded)
        return SearchResult(best, predicted, tolerance, closer, besides, note)

    @staticmethod
    def _integrate_motion(method: Method, setting: float, time_limit: float = inf, *, is_timed: bool = False) -> Trial:
        """Run a method at a setting.

        To be timed it is run twice where the first run is short, unless it took more than half of the time limit.
        """
        paths = [method.stepper.integrate_motion(setting, cpu_limit=time_limit)]
        if is_timed and paths[0].cpu_seconds < min(_MIN_TIMED_SECONDS, 0.5 * time_limit):
            paths.append(method.stepper.integrate_motion(setting, cpu_limit=time_limit))
        return Trial(method, setting, min(paths, key=lambda path: path.cpu_seconds), inf, method.stepper.order)

    def _run_trial(
        self, method: Method, setting: float, time_limit: float, reference_trial: Trial | None = None
    ) -> TrialOutcome[Trial]:
        """Run a method at a setting, and estimate its error if a reference trial exists."""
        try:
            trial = self._integrate_motion(method, setting, time_limit, is_timed=True)
        except TimeBudgetExceeded:
            return TrialOutcome(is_late=True)
        except StepSizeUnderflow as error:
            self._underflows.append(error)
            return TrialOutcome()
        if reference_trial is None:  # the first trial of fixed steps may be far from the error
            is_comparable = not method.stepper.has_fixed_step
            return TrialOutcome(cost=trial.trajectory.cpu_seconds, limits_others=is_comparable, result=trial)
        trial = self._estimate_error(trial, reference_trial)
        return TrialOutcome(trial.error_estimated, trial.trajectory.cpu_seconds, result=trial)

    def _run_first_trials(self, methods: list[Method], step_atol: float) -> list[Trial]:
        """Run all methods and return the trials that are fast enough.

        The time limit is a multiple of the fastest time among methods that choose their steps by the error. The first
        trial of fixed steps may be far from it, and then its time limits nothing.
        """
        found, late = list[Trial](), dict[Method, float]()

        def run_trial(setting: _MethodSetting, time_limit: float) -> TrialOutcome[Trial]:
            late.pop(setting[0], None)
            outcome = self._run_trial(*setting, time_limit)
            if outcome.result:
                found.append(outcome.result)
            elif outcome.is_late:
                late[setting[0]] = time_limit
            return outcome

        candidates = [(0.0, _propose_first_setting(one, one.stepper.initial_setting(step_atol))) for one in methods]
        search_best_first(candidates, run_trial, inf, GiveUpRule(_TIME_LIMIT_FACTOR, _MIN_TIME_LIMIT))
        if not found:
            raise self._underflows[0]
        for method, given in late.items():
            self._print_message(f"  {method}: stopped after {given:.3g} s, because it is slower than others")
        return found

    def _adopt_reference(self, reference: ReferenceTrajectory) -> Trial:
        """Return a given motion as the reference trial."""
        scene = self._error_target.build_scene(self._error_target.frame_seconds, "implicit-euler")
        start = build_initial_state(scene).motion
        positions, velocities = (
            np.array([start.positions, reference.positions[-1]]),
            np.array([start.velocity, reference.velocities[-1]]),
        )
        path = Trajectory(positions, velocities, 1, 0, 0, 0, (0.0, 0.0), 0.0, (0.0,), 0.0)
        stepper = FixedImplicitStepper(lambda h: scene, NewtonSolver(), self._error_target.t_end, 1)
        return Trial(Method("bdf2", "newton", stepper), 1.0, path, reference.get_error_bound(-1), 1.0)

    def _find_reference_trial(self, trials: list[Trial]) -> Trial:
        """Run the reference trial: a motion whose error is much smaller than the target error.

        The method that is predicted to be the cheapest at that accuracy computes it; adaptive methods are preferred.
        """
        best = min(
            trials,
            key=lambda one: (
                one.method.stepper.has_fixed_step,
                self._predict_scaled_cost(one, REFERENCE_ERROR_FRACTION),
            ),
        )
        follower, found = best.method.stepper, best
        order = self._estimate_order(best) if follower.has_fixed_step else float(follower.order)
        part = REFERENCE_ERROR_FRACTION ** (order / (order + 1.0))
        for _ in range(
            _MAX_REFERENCE_TRIALS
        ):  # where frames or stability rule the steps, a closer tolerance may change nothing
            found = self._integrate_motion(best.method, follower.scale_setting(found.setting, part, order))
            if (
                found.trajectory.num_accepted_steps / best.trajectory.num_accepted_steps
            ) ** order >= _MIN_REFERENCE_REFINEMENT:
                break
        begun = self._estimate_error(best, found)
        if ERROR_AIM * self._max_error < begun.error_estimated < inf:
            found = self._integrate_motion(
                best.method,
                follower.scale_setting(found.setting, ERROR_AIM * self._max_error / begun.error_estimated, order),
            )
        return found

    def _estimate_order(self, trial: Trial) -> float:
        """Estimate the order of fixed step sizes by doubling the step twice (Richardson)."""
        two, four = (
            self._integrate_motion(trial.method, parts * trial.setting).trajectory.positions[-1] for parts in (2.0, 4.0)
        )
        first, second = self._compute_distance(trial.trajectory.positions[-1], two), self._compute_distance(two, four)
        fell = log(first / second, 2.0) if 0.0 < first < inf and 0.0 < second < inf else inf
        return min(float(trial.method.stepper.order), max(_MIN_ORDER, fell))

    @staticmethod
    def _predict_scaled_cost(trial: Trial, error_fraction: float) -> float:
        """Predict the CPU seconds at a fraction of the local error; preparation counts once."""
        stepping = min(trial.trajectory.wall_seconds, trial.trajectory.cpu_seconds)
        return trial.trajectory.cpu_seconds - stepping + stepping * error_fraction ** (-1.0 / trial.order)

    def _estimate_error(self, trial: Trial, reference_trial: Trial) -> Trial:
        p, q = trial.trajectory.positions, reference_trial.trajectory.positions
        moved = self._compute_distance(q[-1], q[0])
        least = (reference_trial.step_atol or 0.0) / self._growth.scale
        if self._reference is not None:  # its own error is bounded
            least = self._compute_distance(p[-1], q[-1]) / moved + reference_trial.error_estimated
            return replace(trial, error_estimated=least if least < inf else inf)
        estimated = max(ESTIMATE_SAFETY * self._compute_distance(p[-1], q[-1]) / moved, least) if moved else inf
        return replace(trial, error_estimated=estimated if estimated < inf else inf)

    def _estimate_error_and_order(self, trial: Trial, reference_trial: Trial) -> Trial:
        """Estimate the error of a trial, and its order where necessary.

        The order is measured where fixed steps are not accurate enough.
        """
        trial = self._estimate_error(trial, reference_trial)
        if not trial.method.stepper.has_fixed_step or trial.error_estimated <= self._max_error:
            return trial
        try:
            return _update_order(
                trial, self._estimate_error(self._integrate_motion(trial.method, 2.0 * trial.setting), reference_trial)
            )
        except StepSizeUnderflow:
            return trial

    def _compute_distance(self, p: Positions, q: Positions) -> float:
        return compute_position_error(p, q, self._free_vertices)

    def _predict_cost(self, trial: Trial) -> float:
        """Predict the CPU seconds of a trial's method at the target error.

        The measured time counts where the trial is more accurate, since explicit steps may have reached the stability
        limit.
        """
        return (
            self._predict_scaled_cost(trial, min(1.0, self._choose_error_aim(trial) / trial.error_estimated))
            if trial.error_estimated < inf
            else inf
        )

    def _choose_error_aim(self, trial: Trial) -> float:
        """Return the error for which a setting is chosen."""
        return (_ERROR_AIM_FIXED_STEPS if trial.method.stepper.has_fixed_step else ERROR_AIM) * self._max_error

    def _find_first_reaching(self, trials: list[Trial], reference_trial: Trial) -> tuple[Trial, str]:
        """Return the first trial that reaches the error, and a note.

        The note states why the trial is much more accurate, if it is.

        A method that exceeds the predicted time of the next one by far is tried again after all others.
        """
        nearest, notes = list[Trial](), dict[Method, str]()
        costs = [self._predict_cost(one) for one in trials]

        def propose_settings(trial: Trial, cost: float, limit: float) -> SettingProposals[_MethodSetting, Trial]:
            attempt = 0
            while True:
                tuned = yield from self._tune_setting(trial, cost, limit, attempt)
                if tuned:
                    found, notes[trial.method] = tuned
                    if found.error_estimated > self._max_error:
                        nearest.append(found)
                        self._print_message(
                            f"  {trial.method}: reaches an error of {found.error_estimated:.1e}, "
                            "which shorter steps do not reduce"
                        )
                    return TrialOutcome(found.error_estimated, found.trajectory.cpu_seconds, result=found)
                self._print_message(f"  {trial.method}: takes more than {limit:.3g} s")
                attempt, limit = attempt + 1, _TIME_LIMIT_FACTOR * limit

        candidates = [
            (cost, propose_settings(one, cost, _MAX_COST_RATIO * max(_MIN_TIMED_SECONDS, cost, after)))
            for one, cost, after in zip(trials, costs, [*costs[1:], costs[-1]], strict=True)
        ]
        answer = search_best_first(
            candidates,
            lambda setting, limit: self._run_trial(*setting, limit, reference_trial),
            self._max_error,
            GiveUpRule(_MAX_COST_RATIO, _MAX_COST_RATIO * _MIN_TIMED_SECONDS),
            ends_at_answer=True,
        ).answer
        if answer is None or answer.result is None:
            raise self._build_no_method_error(min(nearest, key=lambda one: one.error_estimated))
        return answer.result, notes[answer.result.method]

    def _tune_setting(
        self, trial: Trial, expected_cost: float, limit: float, attempt: int
    ) -> Generator[SettingProposal[_MethodSetting], TrialOutcome[Trial], tuple[Trial, str] | None]:
        """Tune the setting of a method towards the target error, and return the nearest trial.

        The second result states why the trial is much more accurate than requested, if it is. The result is None if a
        trial takes longer than the limit of CPU seconds.
        """
        best, above = None if trial.error_estimated > self._max_error else trial, None
        nearest, stalled = trial, 0
        for _ in range(_MAX_SETTING_CHANGES):
            if best and best.error_estimated >= ESTIMATE_SAFETY * MIN_ERROR_FRACTION * self._max_error:
                return best, ""
            setting = self._choose_next_setting(trial, best, above)
            if setting == trial.setting:
                return trial, _STABILITY_NOTE
            before = trial
            # A setting that meets the error is made cheaper at once, before other methods are tried.
            cost, repeated = (0.0, 0) if best else (expected_cost, attempt)
            outcome = yield SettingProposal((trial.method, setting), cost, limit, repeated)
            if outcome.result is None:
                if outcome.is_late and best is None:
                    return None
                break
            trial = _update_order(before, outcome.result)
            nearest = min(nearest, trial, key=lambda found: found.error_estimated)
            if trial.error_estimated > self._max_error:
                shorter = (
                    setting < 0.1 * before.setting
                    or trial.trajectory.num_accepted_steps > 4 * before.trajectory.num_accepted_steps
                )
                stalled = (
                    stalled + 1
                    if best is None and trial.error_estimated > 0.5 * before.error_estimated and shorter
                    else 0
                )
                if stalled == _MAX_STALLS:
                    break
                above = trial
            elif best and trial.trajectory.cpu_seconds > 0.9 * best.trajectory.cpu_seconds:
                return best, _STABILITY_NOTE
            else:
                best = trial
        if best is None:
            return nearest, ""
        return (
            best,
            _STABILITY_NOTE if best.error_estimated < ESTIMATE_SAFETY * MIN_ERROR_FRACTION * self._max_error else "",
        )

    def _choose_next_setting(self, trial: Trial, best: Trial | None, above: Trial | None) -> float:
        """Return the next setting to try; between two settings where they bracket the error."""
        if best and above:
            return sqrt(best.setting * above.setting)
        aim = self._choose_error_aim(trial)
        ratio = aim / max(trial.error_estimated, 1e-3 * aim)
        return trial.method.stepper.scale_setting(trial.setting, min(30.0, max(1e-3, ratio)), trial.order)

    def _build_no_method_error(self, nearest: Trial) -> RunFailed:
        at = (
            f" at {nearest.step_atol:.1e} m a step"
            if nearest.step_atol
            else f" with {nearest.trajectory.num_accepted_steps} steps"
        )
        return RunFailed(
            f"no step size reaches an error of {self._max_error:g}: {nearest.method} was closest with "
            f"{nearest.error_estimated:.1g}{at}, which shorter steps do not reduce; "
            "use a larger --error or a shorter "
            "--t-end"
        )


def _propose_first_setting(method: Method, setting: float) -> SettingProposals[_MethodSetting, Trial]:
    """Propose one setting, with a larger limit each time that it takes longer."""
    attempt, limit = 0, _INITIAL_TIME_LIMIT
    while True:
        outcome = yield SettingProposal((method, setting), 0.0, limit, attempt)
        if not outcome.is_late:
            return outcome
        attempt, limit = attempt + 1, _TIME_LIMIT_GROWTH * limit


def _update_order(before: Trial, after: Trial) -> Trial:
    """Return the second trial with the observed order, at most that of its method."""
    shorter = log(after.trajectory.num_accepted_steps / before.trajectory.num_accepted_steps)
    if not (0.0 < before.error_estimated < inf and 0.0 < after.error_estimated < inf and abs(shorter) > 0.1):
        return after
    fell = log(before.error_estimated / after.error_estimated) / shorter
    return replace(after, order=min(float(after.method.stepper.order), max(_MIN_ORDER, fell)))


_STABILITY_NOTE = "longer steps are unstable, or cost as much"
