"""Gates file, a list of performance tests in YAML: `springbench regress gates.yaml`.

gates:
  - {scene: cloth.yaml, size: 32, solver: numba, baseline: sparse, max_ratio: 0.6, agreement_rtol: 1e-6}
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import Field
from springbench.harness.config.config_loader import GATES, read_config
from springbench.harness.config.run_options import IterationLimit, RelativeTolerance
from springbench.harness.config.shipped_configs import resolve_scene_path, suggest_shipped_scene
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.regression.abba_benchmark import (
    BenchmarkResult,
    ClockName,
    ProgramPair,
    run_confirmed_benchmark,
)
from springbench.harness.experiments.regression.confidence_sequence import DEFAULT_ALPHA, SequentialTest
from springbench.harness.experiments.regression.program_pair import (
    DEFAULT_AGREEMENT_RTOL,
    AnswersDiffer,
    build_program_pair,
    require_agreement,
)
from springbench.harness.experiments.regression.solver_pair import prepare_solver_pair
from springbench.harness.scenes.scene_spec import FrameCount, IntegratorName, MeshSize
from springbench.harness.schema.base_model import ConfigModel
from springbench.harness.schema.config_document import ConfigDocument
from springbench.solvers.model.step_problem import NotPositiveDefinite, Unsupported


class RegressionTest(ConfigModel):
    """A performance test of a solver against a baseline on a scene's steps.

    The solver may take at most a given multiple of the baseline's time.
    """

    scene: str
    """The scene's file (*.yaml, or *.json of the assignment), relative to the gates file, or a shipped scene's name."""
    solver: str | dict[str, Any]
    """The tested solver: a name, or a mapping of `name` and the solver's parameters."""
    baseline: str | dict[str, Any]
    """The baseline, in the same form."""
    max_ratio: float = Field(gt=0, le=1e6)
    """The largest ratio of times, the solver's over the baseline's."""
    agreement_rtol: float = Field(default=DEFAULT_AGREEMENT_RTOL, ge=0, le=1)
    """Tolerance of the difference of their positions, relative to the scene's size; nothing is timed if it is
    exceeded."""
    size: MeshSize | None = None
    """Mesh size; the scene's default if left out."""
    max_iterations: IterationLimit = 50
    """Iteration limit of a step."""
    rtol: RelativeTolerance = None
    """Relative tolerance of a step's iterations; null performs all of them."""
    integrator: IntegratorName = "implicit-euler"
    """Time integrator."""
    frames: FrameCount | None = None
    """Maximum number of steps; null uses the scene's."""
    clock: ClockName = "cpu"
    """cpu: CPU time, which other programs hardly affect; wall: elapsed time."""
    budget: float | None = Field(default=None, gt=0, le=86400)
    """Seconds until the test is inconclusive; null uses the command's."""

    @property
    def title(self) -> str:
        """Description of the test."""
        size = f" {self.size}" if self.size else ""
        return f"{Path(self.scene).stem}{size}, {_format_solver(self.solver)} vs {_format_solver(self.baseline)}"


class GatesFile(ConfigModel):
    """A list of performance tests."""

    description: str = Field(default="", max_length=1000)
    """One sentence about what the tests protect."""
    gates: tuple[RegressionTest, ...] = Field(min_length=1)
    """The tests."""


def run_gates_file(
    path: Path, budget: float, print_message: Callable[[str], None], alpha: float = DEFAULT_ALPHA
) -> list[tuple[RegressionTest, BenchmarkResult]]:
    """Run all tests of a gates file, and print each result at once.

    Args:
        path: the gates file.
        budget: seconds of a test without a budget of its own.
        print_message: receives one line per result.
        alpha: error probability of all tests together.

    Raises:
        InputError: for a mistake in the file, or if the answers differ.
    """
    _, document = read_config(path, GATES)
    gates_file = document.validate_data(GatesFile, document.data)
    if gates_file is None:
        raise document.build_error()
    for i, gate in enumerate(gates_file.gates):
        if not resolve_scene_path(gate.scene, path.parent).is_file():
            problem = f"there is no file {path.parent / gate.scene}{suggest_shipped_scene(gate.scene)}"
            document.add_mistake(problem, ("gates", i, "scene"))
    if document.mistakes:
        raise document.build_error()
    found: list[tuple[RegressionTest, BenchmarkResult]] = []
    for i, gate in enumerate(gates_file.gates):
        rule = SequentialTest(gate.max_ratio, alpha / len(gates_file.gates))
        result = run_confirmed_benchmark(
            partial(_start_solvers, document, i, gate), rule, time_budget=gate.budget or budget
        )
        print_message(f"{gate.title}: {result}")
        found.append((gate, result))
    return found


@contextmanager
def _start_solvers(document: ConfigDocument, index: int, test: RegressionTest) -> Generator[ProgramPair]:
    """Prepare both solvers again, warm them up, and check that their answers agree."""
    options = {key: getattr(test, key) for key in ("max_iterations", "rtol", "integrator", "frames")}
    with limit_threads(1):
        try:
            scene = resolve_scene_path(test.scene, document.path.parent)
            candidate, baseline = prepare_solver_pair(scene, test.solver, test.baseline, size=test.size, **options)
            require_agreement(candidate(), baseline(), test.agreement_rtol)
        except (AnswersDiffer, Unsupported, NotPositiveDefinite) as error:
            document.add_mistake(str(error), ("gates", index))
            raise document.build_error() from error
        except InputError as error:
            # Mistakes of a scene or a solver are reported at the line of the test that uses it.
            line = document.lines.get(("gates", index))
            raise InputError(
                [_add_location(mistake, document.path, line, index) for mistake in error.mistakes]
            ) from error
        yield build_program_pair(candidate, baseline, test.clock)


def _add_location(mistake: InputMistake, path: Path, line: int | None, index: int) -> InputMistake:
    if mistake.file and mistake.line:
        return mistake
    return replace(mistake, file=path, line=line, key=f"gates[{index}]")


def _format_solver(solver_input: str | dict[str, Any]) -> str:
    """Describe a solver by its name and parameters."""
    if isinstance(solver_input, str):
        return solver_input
    return " ".join([str(solver_input.get("name", "?")), *(f"{k}={v}" for k, v in solver_input.items() if k != "name")])
