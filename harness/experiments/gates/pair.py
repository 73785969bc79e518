"""Two live worker processes, one for each revision, and the questions that both are asked."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import deque
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from harness.base.errors import InputError

WORKER = Path(__file__).with_name("worker.py")


@dataclass(frozen=True, slots=True)
class Side:
    """A revision as it can be run. name: in messages; tree: the folder that holds it; python: its interpreter;
    checkout: the folder whose revision it is; extra: work that is planted in it, as a part of its own."""

    name: str
    tree: Path
    python: Path = field(default_factory=lambda: Path(sys.executable))
    checkout: Path | None = None
    extra: float = 0.0

    def own(self, file: Path) -> Path:
        """A file of the checkout as the revision has it, and others as they are: those that it lacks too."""
        if self.checkout and file.is_relative_to(self.checkout):
            there = self.tree / file.relative_to(self.checkout)
            return there if there.exists() else file
        return file


@dataclass(frozen=True, slots=True, eq=False)
class HeldWork:
    """What a worker holds: its answer, its exact facts, the clock that suits it, and its frames where it has some."""

    answer: NDArray[np.float64]
    facts: dict[str, int]
    clock: str
    frames: int


class RevisionProcess:
    """A process that holds one revision's work. Errors are InputErrors, in the revision's own words."""

    def __init__(self, side: Side, scratch: Path) -> None:
        self.side, self._answer = side, scratch / f"{side.name.replace('/', '_')}.npy"
        # The script's own folder would come first on the path, and its neighbours hide modules of other names.
        environment = {**os.environ, "PYTHONPATH": _path(side), "PYTHONSAFEPATH": "1"}
        command = [str(side.python), str(WORKER)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, cwd=side.tree, env=environment, text=True, stdin=pipe, stdout=pipe, stderr=pipe
        )
        self._said: deque[str] = deque(maxlen=20)
        self._listener = Thread(target=self._listen, daemon=True)
        self._listener.start()

    def ask(self, do: str, **asked: Any) -> dict[str, Any]:
        """The answer to a request; raises InputError with what the worker says is wrong."""
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps({"do": do, **asked}) + "\n")
            process.stdin.flush()
        line = process.stdout.readline()
        if not line:
            process.wait()
            self._listener.join()
            last = self._said[-1] if self._said else f"its process ended with code {process.returncode}"
            raise InputError(f"{self.side.name}: does not run: {last}")
        answer = json.loads(line)
        if "error" in answer:
            raise InputError(f"{self.side.name}: does not run: {answer['error']}")
        return answer

    def hold(self, do: str, **asked: Any) -> HeldWork:
        """Ask for work to be held; see `worker.py`."""
        told = self.ask(do, positions=str(self._answer), **asked)
        return HeldWork(np.load(self._answer), told["facts"], told["clock"], told.get("frames", 0))

    def instructions(self) -> int | None:
        """The instructions that one call of the work retires, None where the machine does not tell."""
        return self.ask("instructions")["instructions"]

    def seconds(self, calls: int, clock: str) -> float:
        """The seconds that so many calls of the work take, together."""
        return self.ask("time", calls=calls, clock=clock)["seconds"]

    def renew(self) -> None:
        """Make the work that it holds anew, elsewhere in memory."""
        self.ask("renew")

    def close(self) -> None:
        """End the process."""
        process = self._process
        for pipe in (process.stdin, process.stdout):
            if pipe:
                with suppress(BrokenPipeError):
                    pipe.close()
        try:
            process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _listen(self) -> None:
        """Keep the last lines of standard error; a full pipe would stop the process."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.strip():
                self._said.append(line.strip())


def _path(side: Side) -> str:
    """The tree, then what was on the path already, where it lies in the checkout the tree's own."""
    given = [Path(entry).resolve() for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    mapped = [
        side.tree / entry.relative_to(side.checkout) if side.checkout and entry.is_relative_to(side.checkout) else entry
        for entry in given
    ]
    return os.pathsep.join(map(str, dict.fromkeys([side.tree, *mapped])))


@contextmanager
def workers(*sides: Side) -> Generator[list[RevisionProcess]]:
    """A live worker for each side; all end with the block."""
    alive: list[RevisionProcess] = []
    with TemporaryDirectory(prefix="springbench-") as scratch:
        try:
            for number, side in enumerate(sides):
                folder = Path(scratch) / str(number)
                folder.mkdir()
                alive.append(RevisionProcess(side, folder))
            yield alive
        finally:
            for worker in alive:
                worker.close()


SAME = 0.001
"""The part by which instructions may differ: the interpreter's own housekeeping."""


def changes(new: dict[str, int], old: dict[str, int]) -> list[str]:
    """What differs of exact facts, in words: iterations, entries, bytes, flops, instructions."""
    allowed = {name: SAME * old[name] if name == "instructions" else 0 for name in old}
    both = [name for name in old if name in new and abs(new[name] - old[name]) > allowed[name]]
    return [f"{name} {old[name]:,} -> {new[name]:,} ({new[name] / old[name] - 1:+.1%})" for name in both if old[name]]
