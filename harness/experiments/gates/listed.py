"""Table of performance tests in a YAML file: `springbench gate gates.yaml`.

gates:
  - {scene: cloth.yaml, size: 32, solver: numba, against: sparse, limit: 0.6, agree: 1e-6}
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import Field

from harness.base.document import Document
from harness.base.errors import InputError, Mistake
from harness.base.machine import pinned_threads
from harness.base.model import Model
from harness.base.yaml import read_yaml
from harness.config.options import Iterations, Tolerance
from harness.experiments.gates.abba import Clock, Racers, Result, confirmed
from harness.experiments.gates.agreement import AGREEMENT, difference
from harness.experiments.gates.scenes import calls_of, pair, timed
from harness.experiments.gates.sequential import ALPHA, Rule
from harness.scenes.spec import Frames, IntegratorName, Size
from solvers.problem import NotPositiveDefinite, Unsupported


class Gate(Model):
    """A performance test of a solver against a baseline on a scene's steps.

    The solver may take at most a given multiple of the baseline's time.
    """

    scene: str
    """The scene's file (*.yaml, or *.json of the assignment), relative to the table."""
    solver: str | dict[str, Any]
    """The tested solver: a name, or a mapping of `name` and the solver's parameters."""
    against: str | dict[str, Any]
    """The baseline, in the same form."""
    limit: float = Field(gt=0, le=1e6)
    """The largest ratio of times, the solver's over the baseline's."""
    agree: float = Field(default=AGREEMENT, ge=0, le=1)
    """Tolerance of the difference of their positions, relative to the scene's size; nothing is timed if it is
    exceeded."""
    size: Size | None = None
    """Mesh size; the scene's default if left out."""
    iterations: Iterations = 50
    """Iteration limit of a step."""
    tolerance: Tolerance = None
    """Relative tolerance of a step's iterations; null performs all of them."""
    integrator: IntegratorName = "implicit-euler"
    """Time integrator."""
    frames: Frames | None = None
    """Maximum number of steps; null uses the scene's."""
    clock: Clock = "cpu"
    """cpu: CPU time, which other programs hardly affect; wall: elapsed time."""
    budget: float | None = Field(default=None, gt=0, le=86400)
    """Seconds until the test is inconclusive; null uses the command's."""

    @property
    def title(self) -> str:
        """Description of the test."""
        size = f" {self.size}" if self.size else ""
        return f"{Path(self.scene).stem}{size}, {_name(self.solver)} against {_name(self.against)}"


class ListedGates(Model):
    """A table of performance tests."""

    description: str = Field(default="", max_length=1000)
    """One sentence about what the tests protect."""
    gates: tuple[Gate, ...] = Field(min_length=1)
    """The tests."""


def run_table(path: Path, budget: float, say: Callable[[str], None], alpha: float = ALPHA) -> list[tuple[Gate, Result]]:
    """Run all tests of a table, and print each result at once.

    Args:
        path: the table.
        budget: seconds of a test without a budget of its own.
        say: receives one line per result.
        alpha: error probability of all tests together.
    Raises:
        InputError: for a mistake in the table, or if the answers differ.
    """
    document = read_yaml(path)
    table = document.check(ListedGates, document.data)
    if table is None:
        raise document.error()
    for i, gate in enumerate(table.gates):
        if not (path.parent / gate.scene).is_file():
            document.report(f"there is no file {path.parent / gate.scene}", ("gates", i, "scene"))
    if document.mistakes:
        raise document.error()
    found: list[tuple[Gate, Result]] = []
    for i, gate in enumerate(table.gates):
        rule = Rule(gate.limit, alpha / len(table.gates))
        result = confirmed(partial(_started, document, i, gate), rule, budget=gate.budget or budget)
        say(f"{gate.title}: {result}")
        found.append((gate, result))
    return found


@contextmanager
def _started(document: Document, i: int, gate: Gate) -> Generator[Racers]:
    """Prepare both solvers again, warm them up, and check that their answers agree."""
    options = {key: getattr(gate, key) for key in ("iterations", "tolerance", "integrator", "frames")}
    with pinned_threads(1):
        try:
            candidate, yardstick = pair(
                document.path.parent / gate.scene, gate.solver, gate.against, size=gate.size, **options
            )
            said = difference(candidate(), yardstick(), gate.agree)
        except (Unsupported, NotPositiveDefinite) as error:
            document.report(f"cannot be run: {error}", ("gates", i))
            raise document.error() from error
        except InputError as error:
            # Mistakes of a scene or a solver are reported at the line of the test that uses it.
            line = document.lines.get(("gates", i))
            raise InputError([_placed(mistake, document.path, line, i) for mistake in error.mistakes]) from error
        if said:
            document.report(f"the answers differ, so nothing was timed: {said}", ("gates", i))
            raise document.error()
        calls = calls_of(candidate, yardstick)
        yield Racers(timed(candidate, calls, gate.clock), timed(yardstick, calls, gate.clock))


def _placed(mistake: Mistake, path: Path, line: int | None, i: int) -> Mistake:
    if mistake.file and mistake.line:
        return mistake
    return replace(mistake, file=path, line=line, key=f"gates[{i}]")


def _name(given: str | dict[str, Any]) -> str:
    """Describe a solver by its name and parameters."""
    if isinstance(given, str):
        return given
    return " ".join([str(given.get("name", "?")), *(f"{k}={v}" for k, v in given.items() if k != "name")])
