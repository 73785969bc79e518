# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUnknownMemberType=false
# SciPy's and NumPy's stubs leave the types of some results unknown.
"""Fingerprints of mistakes: which program predicts each step of a submission.

A step is predicted from the two positions before it.

    D = rms over steps of |predicted - p|_F / scale,   scale = |p - p^t|_F + |predicted by the correct program - p^t|_F
    fit of a mistake = 1 - D(mistake)/D(correct program)

A prediction starts from the submission's own positions, so that deviations do not accumulate and motion that is
sensitive to the start does not matter. The correct programs are local-global with any number of iterations from the
required one on, from p^t or from the inertial target, and the certified minimum. A mistake is named where the correct
programs fail beyond what the stored digits explain, and the mistake explains MIN_FIT of that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from springbench.harness.experiments.grading.mistaken_programs import (
    MISTAKES,
    AssignmentProgram,
    ProgramMistake,
    StepBatch,
    change_time_step,
)
from springbench.harness.experiments.grading.spring_terms import SpringTerms, build_step_problem
from springbench.harness.experiments.grading.submission import StoredPrecision, SubmittedMotion
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import build_initial_state
from springbench.solvers.model.step_problem import Positions, StepProblem

MIN_FIT = 0.9
"""Least part of the deviation that a mistake explains where it is named."""
MIN_DEVIATION = 1e-4
"""Deviation up to which a submission counts as correct, relative to its steps."""
NOISE_FACTOR = 20.0
"""Factor on the stored digits' share of the deviation, up to which a submission counts as correct."""
SAME_FACTOR = 3.0
"""Mistakes whose deviations differ by less than this factor, or by the noise, cannot be distinguished."""
CONVERGED_FACTOR = 1.5
"""Largest ratio to the least deviation of all iterates at which an iterate explains a submission as well."""
MINIMUM_FACTOR = 10.0
"""Largest ratio to that deviation at which the minima of the steps explain a submission as well.

They are compared more leniently, since a program may stop before it is at the minimum.
"""
MAX_ITERATIONS = 100
"""Number of iterations whose iterates are compared, unless more are required."""
MIN_MISTAKEN_ITERATIONS = 10
"""Least number of iterations of a program with a mistake: fewer are a mistake of their own."""
MAX_COMPARED_STEPS = 8
"""Number of steps that are predicted."""
NUM_FINALISTS = 8
"""Number of programs that are compared on all of these steps; all programs are compared on three."""
CLEAR_FACTOR = 1e3
"""Least ratio of a step to the rounding errors of its positions."""
FINISHED = 1e-15
"""Change of iterates, relative to the scale, below which no further ones are computed."""
SAME_TIME_STEP = 1e-3
"""Relative difference from the scene's time step up to which a fitted one is the same."""
TIME_STEP_RANGE = 40.0
"""Largest ratio of a wrong time step to the scene's."""
INVISIBLE = 1e-7
"""Deviation from the correct program up to which a mistake has no effect on a scene."""

FindMinimum = Callable[[StepProblem, Positions], Positions | None]


@dataclass(frozen=True, slots=True)
class NamedMistake:
    """A mistake and how well it fits.

    Attributes:
        name: short name.
        description: what the program does.
        remedy: what to look at.
        fit: part of the deviation that it explains, at most 1.
        deviation: remaining deviation D.
    """

    name: str
    description: str
    remedy: str
    fit: float
    deviation: float


@dataclass(frozen=True, slots=True)
class ProgramFingerprint:
    """The programs that are closest to a submission.

    Attributes:
        deviation: deviation D of the closest correct program.
        noise: share of the stored digits in D.
        correct_program: the closest correct program in words.
        iterations: number of iterations of local-global that fits best; None for the minimum.
        closest: mistakes, closest first; empty where a correct program explains the submission.
        mistake: the mistake that is named; None where there is none.
        alike: names of mistakes that are indistinguishable from the named one in this scene.
        invisible: names of mistakes that have no effect on this scene.
    """

    deviation: float
    noise: float
    correct_program: str
    iterations: int | None
    closest: tuple[NamedMistake, ...]
    mistake: NamedMistake | None
    alike: tuple[str, ...]
    invisible: tuple[str, ...]

    @property
    def is_correct(self) -> bool:
        """Whether a correct program explains the submission."""
        return self.deviation <= max(MIN_DEVIATION, NOISE_FACTOR * self.noise)


class _Comparison(NamedTuple):
    """Steps to be predicted.

    Attributes:
        steps: the steps.
        scales: scale (s,) [m] of each.
        noise: share of the stored digits in D.
    """

    steps: StepBatch
    scales: NDArray[np.float64]
    noise: float

    def select_steps(self, rows: Sequence[int]) -> _Comparison:
        """Return the comparison on some of the steps."""
        return _Comparison(self.steps.select_steps(rows), self.scales[list(rows)], self.noise)


class FingerprintFinder:
    """Finds the closest program of submissions of one scene."""

    def __init__(self, scene: Scene, terms: SpringTerms, required_iterations: int | None) -> None:
        """Prepare the programs.

        Args:
            scene: scene of the terms below.
            terms: terms of the scene.
            required_iterations: iterations that a step should have; None for convergence.
        """
        self._scene, self._terms, self._required = scene, terms, required_iterations
        self._start = build_initial_state(scene).motion.positions
        self._correct = AssignmentProgram.from_terms(terms)
        rest = scene.mesh.rest_positions
        self._programs = {
            mistake.name: [variant(self._correct, rest) for variant in mistake.variants] for mistake in MISTAKES
        }
        self._num_iterations = max(MAX_ITERATIONS, required_iterations or 0)

    def find_fingerprint(self, submission: SubmittedMotion, find_minimum: FindMinimum) -> ProgramFingerprint:
        """Find the closest programs.

        Args:
            submission: positions.
            find_minimum: finds the minimum of a step's objective in the basin of some positions.
        """
        with np.errstate(all="ignore"):
            return self._find_fingerprint(submission, find_minimum)

    def _find_fingerprint(self, submission: SubmittedMotion, find_minimum: FindMinimum) -> ProgramFingerprint:
        chosen, all_steps = self._select_steps(submission.positions, submission.precision)
        noise = all_steps.noise
        by_count = self._compare_correct(all_steps)
        lowest, limit = float(by_count.min()), max(MIN_DEVIATION, NOISE_FACTOR * noise)
        k = int(np.argmax(by_count <= max(CONVERGED_FACTOR * lowest, noise))) + 1
        allowed = float(by_count[(self._required or 1) - 1 :].min())
        at_minimum = np.inf if allowed <= limit else self._compare_minima(submission, chosen, all_steps, find_minimum)
        deviation = min(allowed, at_minimum)
        is_minimum = at_minimum <= max(MINIMUM_FACTOR * lowest, noise)
        words = f"local-global with {k} iterations a step"
        if is_minimum:
            words = "a solver that converges in every step"
        elif by_count[-1] <= max(CONVERGED_FACTOR * lowest, noise):
            words = f"local-global, which has converged after {k} iterations of each step"
        correct = words, None if is_minimum else k
        visible = self._find_visible_programs(all_steps)
        names = {mistake.name for mistake, _ in visible}
        invisible = tuple(one.name for one in MISTAKES if one.variants and one.name not in names)
        if deviation <= limit:
            return ProgramFingerprint(deviation, noise, *correct, (), None, (), invisible)
        found = self._compare_mistakes(submission, all_steps, visible)
        found.append(self._fit_time_step(all_steps))
        if self._required and k < self._required:
            found.append((_describe_iterations(k, self._required), float(by_count[k - 1])))
        found.sort(key=lambda one: one[1])
        named = tuple(NamedMistake(m.name, m.description, m.remedy, _compute_fit(d, deviation), d) for m, d in found)
        best = named[0] if named[0].fit >= MIN_FIT else None
        alike = tuple(
            one.name for one in named[1:] if best and one.deviation <= max(SAME_FACTOR * best.deviation, noise, 1e-9)
        )
        return ProgramFingerprint(deviation, noise, *correct, named[:5], best, alike, invisible)

    def _compare_minima(
        self, submission: SubmittedMotion, chosen: Sequence[int], compared: _Comparison, find_minimum: FindMinimum
    ) -> float:
        """Return D of the minima of the steps; infinite where there are none."""
        found = [
            find_minimum(self._build_problem(submission.positions, step), submission.position_after(step))
            for step in chosen
        ]
        rows = [row for row, p in enumerate(found) if p is not None]
        if not rows:
            return np.inf
        return _measure_deviation(np.array([found[row] for row in rows]), compared.select_steps(rows))

    def _select_steps(self, sequence: NDArray[np.float64], precision: StoredPrecision) -> tuple[list[int], _Comparison]:
        """Select the steps to predict: the first three, and others in which much moves.

        Steps that are shorter than the stored digits are left out, if others are longer.
        """
        count = len(sequence) - 2
        errors = np.array([precision.bound_error(*sequence[k - 1 : k + 2]) for k in range(1, count + 1)])
        errors *= np.sqrt(sequence[0].size)
        moved = np.array([_distance(sequence[k + 1], sequence[k]) for k in range(1, count + 1)])
        chosen, order = set(range(1, min(3, count) + 1)), np.linspace(1, count, 4 * MAX_COMPARED_STEPS)
        for step in dict.fromkeys(round(x) for x in (*order[::4], *order)):
            if len(chosen) >= MAX_COMPARED_STEPS:
                break
            if moved[step - 1] > CLEAR_FACTOR * errors[step - 1]:
                chosen.add(step)
        steps = sorted(chosen)
        batch = self._build_batch(sequence, steps)
        scales = self._measure_scales(batch)
        clear = [k for k, step in enumerate(steps) if scales[k] >= CLEAR_FACTOR * errors[step - 1]]
        if len(clear) > 1:
            steps, batch, scales = [steps[k] for k in clear], batch.select_steps(clear), scales[clear]
        noise = _rms(4.0 * errors[np.array(steps) - 1] / scales)
        return steps, _Comparison(batch, scales, noise)

    def _build_problem(self, sequence: NDArray[np.float64], step: int) -> StepProblem:
        return build_step_problem(self._scene, sequence[step], sequence[step - 1], step - 1)

    def _build_batch(self, sequence: NDArray[np.float64], steps: Sequence[int]) -> StepBatch:
        problems = [self._build_problem(sequence, step) for step in steps]
        at = np.array(steps)
        return StepBatch(
            sequence[at - 1],
            sequence[at],
            np.array([problem.inertial_target for problem in problems]),
            np.array([problem.external_force for problem in problems]),
            np.array([problem.pin_targets for problem in problems]),
            sequence[at + 1],
        )

    def _measure_scales(self, steps: StepBatch) -> NDArray[np.float64]:
        """Measure the scale of steps: what each moves, and what the correct program moves."""
        predicted = next(islice(self._correct.iterate_steps(steps), 9, None))
        tiny = np.finfo(float).eps * np.abs(steps.current).max(axis=(1, 2)) + np.finfo(float).tiny
        return _distances(steps.after, steps.current) + _distances(predicted, steps.current) + tiny

    def _compare_correct(self, compared: _Comparison) -> NDArray[np.float64]:
        """Return D of the correct program after each number of iterations.

        It is the smaller value of two initial guesses.
        """
        guesses = (self._correct, replace(self._correct, initial_guess="target"))
        return np.min([self._compare(program, compared) for program in guesses], axis=0)

    def _compare(self, program: AssignmentProgram, compared: _Comparison) -> NDArray[np.float64]:
        """Return D of a program after each number of iterations, infinite where it fails."""
        count = 1 if program.explicit_at else self._num_iterations
        found, before = np.full(count, np.inf), None
        try:
            for k, p in enumerate(islice(program.iterate_steps(compared.steps), count)):
                found[k] = _measure_deviation(p, compared)
                if before is not None and float(np.max(_distances(p, before) / compared.scales)) < FINISHED:
                    found[k:] = found[k]
                    break
                before = p
        except RuntimeError:  # a singular matrix
            return np.full(count, np.inf)
        return found

    def _compare_mistakes(
        self,
        submission: SubmittedMotion,
        compared: _Comparison,
        visible: Sequence[tuple[ProgramMistake, AssignmentProgram]],
    ) -> list[tuple[ProgramMistake, float]]:
        """Return D of all mistakes.

        Those with large deviations on some steps are not compared on the others.
        """
        count = len(compared.scales)
        screening = compared.select_steps(sorted({0, min(1, count - 1), count // 2}))
        others = list[tuple[ProgramMistake, float]]()
        ranked = [(self._compare_best(one[1], screening), place, *one) for place, one in enumerate(visible)]
        for mistake in MISTAKES:
            if outputs := list(_undo_output(mistake, submission)):
                deviation = min(self._compare_output(undone, submission.precision) for undone in outputs)
                others.append((mistake, deviation))
        ranked.sort(key=lambda one: one[:2])
        found, farthest = dict[str, tuple[ProgramMistake, float]](), 0.0
        for place, (screened, _, mistake, program) in enumerate(ranked):
            if place < NUM_FINALISTS:
                d = self._compare_best(program, compared)
                farthest = max(farthest, d)
            else:
                d = max(screened, farthest)
            if mistake.name not in found or d < found[mistake.name][1]:
                found[mistake.name] = mistake, d
        return [*found.values(), *others]

    def _compare_best(self, program: AssignmentProgram, compared: _Comparison) -> float:
        """Return D of a program with the number of iterations that fits best."""
        first = 0 if program.explicit_at else MIN_MISTAKEN_ITERATIONS - 1
        return float(self._compare(program, compared)[first:].min())

    def _compare_output(self, undone: NDArray[np.float64], precision: StoredPrecision) -> float:
        """Return D of the correct program on positions with an output mistake undone.

        Their start counts as a step.
        """
        if len(undone) < 3:
            return np.inf
        _, compared = self._select_steps(undone, precision)
        best = float(self._compare_correct(compared)[(self._required or MIN_MISTAKEN_ITERATIONS) - 1 :].min())
        return float(np.hypot(best, _distance(undone[1], self._start) / float(compared.scales.max())))

    def _fit_time_step(self, compared: _Comparison) -> tuple[ProgramMistake, float]:
        """Fit the time step, and return it as a mistake."""
        count, dt = len(compared.scales), self._terms.time_step
        some = compared.select_steps(sorted({0, min(1, count - 1), count - 1}))

        def deviation(logarithm: float) -> float:
            return self._compare_best(change_time_step(self._correct, dt * float(np.exp(logarithm))), some)

        grid = np.linspace(-np.log(TIME_STEP_RANGE), np.log(TIME_STEP_RANGE), 16)  # an even number: none at 0
        values = [deviation(x) for x in grid]
        at = int(np.argmin(values))
        low, high = grid[max(0, at - 1)], grid[min(len(grid) - 1, at + 1)]
        best: Any = minimize_scalar(deviation, bounds=(low, high), method="bounded", options={"xatol": 1e-7})
        found = dt * float(np.exp(best.x))
        if abs(best.x) < SAME_TIME_STEP:
            return _describe_time_step(found, dt), np.inf
        return _describe_time_step(found, dt), self._compare_best(change_time_step(self._correct, found), compared)

    def _find_visible_programs(self, compared: _Comparison) -> list[tuple[ProgramMistake, AssignmentProgram]]:
        """Return the mistakes and their programs whose steps differ from those of the correct program."""
        few = compared.select_steps(range(min(3, len(compared.scales))))
        correct = next(islice(self._correct.iterate_steps(few.steps), 4, None))
        tiny = np.finfo(float).eps * np.abs(few.steps.current).max(axis=(1, 2)) + np.finfo(float).tiny
        few = few._replace(scales=_distances(correct, few.steps.current) + tiny)  # steps of the submission may be huge
        pairs = [(mistake, program) for mistake in MISTAKES for program in self._programs[mistake.name]]
        return [(mistake, program) for mistake, program in pairs if not self._is_alike(program, correct, few)]

    def _is_alike(self, program: AssignmentProgram, correct: Positions, compared: _Comparison) -> bool:
        try:
            p = next(islice(program.iterate_steps(compared.steps), 4, None))
        except RuntimeError:
            return False
        return bool((_distances(p, correct) <= INVISIBLE * compared.scales).all())


def _undo_output(mistake: ProgramMistake, submission: SubmittedMotion) -> Iterator[NDArray[np.float64]]:
    """Yield the positions with a mistake of the output undone."""
    sequence = submission.positions
    if mistake.is_late:
        yield np.concatenate([sequence[:1], sequence[2:]])
    own = 1 if submission.has_start else 2
    for axes in mistake.axes:
        undone = sequence.copy()
        undone[own:] = sequence[own:][:, :, list(axes)]
        yield undone


def _describe_time_step(found: float, dt: float) -> ProgramMistake:
    words = f"uses a time step of {found:.4g} s instead of {dt:.4g} s"
    if abs(found / dt**0.5 - 1.0) < 1e-2:
        words = "divides by dt instead of dt^2"
    elif abs(found - 1.0) < 1e-2:
        words = "does not divide by dt^2"
    return ProgramMistake("wrong time step", words, "M/dt^2 in Q and in y, with the dt of the scene")


def _describe_iterations(found: int, required: int) -> ProgramMistake:
    words = f"takes {found} iteration{'s' if found > 1 else ''} a step instead of {required}"
    return ProgramMistake(
        "too few iterations", words, f"{required} iterations of the local and the global step in each step"
    )


def _compute_fit(deviation: float, of_correct: float) -> float:
    return float(max(0.0, 1.0 - deviation / of_correct)) if of_correct > 0.0 else 0.0


def _measure_deviation(p: Positions, compared: _Comparison) -> float:
    """Return D of predictions (s, n, 3) [m]."""
    relative = _distances(p, compared.steps.after) / compared.scales
    deviation = float(np.sqrt(relative @ relative / len(relative)))
    return deviation if deviation < np.inf else np.inf  # of NaN too


def _distances(p: Positions, q: Positions) -> NDArray[np.float64]:
    """Return |p - q|_F (s,) [m] of positions (s, n, 3)."""
    return np.linalg.norm((p - q).reshape(len(p), -1), axis=1)


def _distance(p: Positions, q: Positions) -> float:
    """Return |p - q|_F [m]; infinite on overflow."""
    away = float(np.linalg.norm(p - q))
    return away if np.isfinite(away) else np.inf


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
