"""Processes that run one revision each, and the requests that both receive."""

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
    """A git revision that can be run.

    name: name in messages.
    tree: folder of its files.
    python: its Python interpreter.
    checkout: folder that the revision belongs to.
    extra: artificial extra work, as a fraction of its own.
    """

    name: str
    tree: Path
    python: Path = field(default_factory=lambda: Path(sys.executable))
    checkout: Path | None = None
    extra: float = 0.0

    def own(self, file: Path) -> Path:
        """Return the revision's version of a file of the checkout.

        Other and missing files are returned unchanged.
        """
        if self.checkout and file.is_relative_to(self.checkout):
            there = self.tree / file.relative_to(self.checkout)
            return there if there.exists() else file
        return file


@dataclass(frozen=True, slots=True, eq=False)
class HeldWork:
    """Work that a process has prepared.

    answer: result of the work.
    facts: deterministic counts.
    clock: clock that suits the work.
    frames: number of steps, 0 if the work has none.
    """

    answer: NDArray[np.float64]
    facts: dict[str, int]
    clock: str
    frames: int


class RevisionProcess:
    """A process that runs one revision's work; errors become InputErrors with the revision's own message."""

    def __init__(self, side: Side, scratch: Path) -> None:
        self.side, self._answer = side, scratch / f"{side.name.replace('/', '_')}.npy"
        # The script's folder would come first on the path, and files next to it would shadow modules of other names.
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
        """Send a request and return its answer.

        Args:
            do: name of the request.
            asked: its arguments, which JSON can represent.
        Raises:
            InputError: with the worker's message, or if its process has ended.
        """
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
        """Request the preparation of work; `revision_worker.py` lists the commands."""
        told = self.ask(do, positions=str(self._answer), **asked)
        return HeldWork(np.load(self._answer), told["facts"], told["clock"], told.get("frames", 0))

    def instructions(self) -> int | None:
        """Count the instructions of one call of the work; None if the machine hides them."""
        return self.ask("instructions")["instructions"]

    def seconds(self, calls: int, clock: str) -> float:
        """Time calls of the work together.

        Args:
            calls: number of calls.
            clock: cpu or wall.
        Returns: seconds.
        """
        return self.ask("time", calls=calls, clock=clock)["seconds"]

    def renew(self) -> None:
        """Rebuild the prepared work at other addresses."""
        self.ask("renew")

    def close(self) -> None:
        """Stop the process."""
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
        """Read standard error and store its last lines; a full pipe would block the process."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.strip():
                self._said.append(line.strip())


def _path(side: Side) -> str:
    """Build the Python path of a revision.

    The worktree comes first, then existing entries, mapped from the checkout to the worktree.
    """
    given = [Path(entry).resolve() for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    mapped = [
        side.tree / entry.relative_to(side.checkout) if side.checkout and entry.is_relative_to(side.checkout) else entry
        for entry in given
    ]
    return os.pathsep.join(map(str, dict.fromkeys([side.tree, *mapped])))


@contextmanager
def workers(*sides: Side) -> Generator[list[RevisionProcess]]:
    """Start a worker process for each revision; all stop at the end of the block."""
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
"""Relative tolerance of instruction counts, for internal work of the interpreter."""


def changes(new: dict[str, int], old: dict[str, int]) -> list[str]:
    """Describe the differences of deterministic counts: iterations, entries, bytes, flops, instructions.

    Args:
        new: counts of this checkout.
        old: counts of the revision.
    Returns: one text per difference.
    """
    allowed = {name: SAME * old[name] if name == "instructions" else 0 for name in old}
    both = [name for name in old if name in new and abs(new[name] - old[name]) > allowed[name]]
    return [f"{name} {old[name]:,} -> {new[name]:,} ({new[name] / old[name] - 1:+.1%})" for name in both if old[name]]
