"""Gates from a table, without Python: `springbench gate gates.yaml`.

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
    """A gate: a solver that must take at most `limit` times as long as another on a scene's steps."""

    scene: str
    """The scene's file (*.yaml, or *.json of the assignment), relative to the table."""
    solver: str | dict[str, Any]
    """The solver that must not be slow: a name, or a mapping of `name` and the solver's parameters."""
    against: str | dict[str, Any]
    """What it is compared with, likewise."""
    limit: float = Field(gt=0, le=1e6)
    """The largest ratio of times, the solver's over the other's."""
    agree: float = Field(default=AGREEMENT, ge=0, le=1)
    """How far their positions may lie apart, in the scene's size; nothing is timed where they lie further."""
    size: Size | None = None
    """Mesh size; the scene's default if left out."""
    iterations: Iterations = 50
    """Iteration limit of a step."""
    tolerance: Tolerance = None
    """Relative tolerance that ends a step's iterations; null does all of them."""
    integrator: IntegratorName = "implicit-euler"
    """How time is integrated."""
    frames: Frames | None = None
    """Number of steps at most; null takes the scene's."""
    clock: Clock = "cpu"
    """cpu, which other programs hardly move, or wall, what one waits."""
    budget: float | None = Field(default=None, gt=0, le=86400)
    """Seconds until the gate says that it cannot tell; null takes the command's."""

    @property
    def title(self) -> str:
        """The gate in words."""
        size = f" {self.size}" if self.size else ""
        return f"{Path(self.scene).stem}{size}, {_name(self.solver)} against {_name(self.against)}"


class ListedGates(Model):
    """A table of gates."""

    description: str = Field(default="", max_length=1000)
    """One sentence about what the gates guard."""
    gates: tuple[Gate, ...] = Field(min_length=1)
    """The gates."""


def run_table(path: Path, budget: float, say: Callable[[str], None], alpha: float = ALPHA) -> list[tuple[Gate, Result]]:
    """Run all gates of a table; each result is told as it comes.

    budget: seconds of a gate that does not say itself; alpha: the error of all gates together.
    Raises InputError, also for answers that differ.
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
    """Both solvers prepared anew, warm, with the same answer."""
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
            # What a scene or a solver lacks is told with the line of the gate that asked for it.
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
    """A solver in words."""
    if isinstance(given, str):
        return given
    return " ".join([str(given.get("name", "?")), *(f"{k}={v}" for k, v in given.items() if k != "name")])
