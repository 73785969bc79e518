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
from springbench.harness.errors import InputError

WORKER_SCRIPT = Path(__file__).with_name("revision_worker.py")

PACKAGE_FOLDER = ".src"
"""Folder of a checkout from which `springbench` is imported."""


@dataclass(frozen=True, slots=True)
class GitRevision:
    """A git revision that can be run.

    Attributes:
        name: name in messages.
        worktree: folder of its files.
        interpreter: its Python interpreter.
        checkout: checkout that the revision belongs to; None for the checkout itself.
        injected_slowdown: artificial extra work, as a fraction of the revision's work.
    """

    name: str
    worktree: Path
    interpreter: Path = field(default_factory=lambda: Path(sys.executable))
    checkout: Path | None = None
    injected_slowdown: float = 0.0

    def resolve_file(self, file: Path) -> Path:
        """Return the revision's version of a file of the checkout.

        Other and missing files are returned unchanged.
        """
        if self.checkout and file.is_relative_to(self.checkout):
            there = self.worktree / file.relative_to(self.checkout)
            return there if there.exists() else file
        return file


@dataclass(frozen=True, slots=True, eq=False)
class PreparedWork:
    """Work that a process has prepared.

    Attributes:
        answer: result of the work.
        stats: deterministic counts.
        clock: clock that suits the work.
        num_frames: number of steps, 0 if the work has none.
    """

    answer: NDArray[np.float64]
    stats: dict[str, int]
    clock: str
    num_frames: int


class WorkSkipped(Exception):
    """The work lacks an input outside the checkout."""


class RevisionProcess:
    """A process that runs one revision's work; errors become InputErrors with the revision's own message."""

    def __init__(self, revision: GitRevision, scratch: Path) -> None:
        self.revision, self._answer_path = revision, scratch / f"{revision.name.replace('/', '_')}.npy"
        # The script's folder would come first on the path, and files next to it would shadow modules of other names.
        environment = {**os.environ, "PYTHONPATH": _build_python_path(revision), "PYTHONSAFEPATH": "1"}
        command = [str(revision.interpreter), str(WORKER_SCRIPT)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            command, cwd=revision.worktree, env=environment, text=True, stdin=pipe, stdout=pipe, stderr=pipe
        )
        self._error_lines: deque[str] = deque(maxlen=20)
        self._listener = Thread(target=self._read_errors, daemon=True)
        self._listener.start()

    def send_request(self, command: str, **arguments: Any) -> dict[str, Any]:
        """Send a request and return its answer.

        Args:
            command: name of the request.
            arguments: its arguments, which JSON can represent.

        Raises:
            InputError: with the worker's message, or if its process has ended.
            WorkSkipped: if the work lacks an input.
        """
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps({"command": command, **arguments}) + "\n")
            process.stdin.flush()
        line = process.stdout.readline()
        if not line:
            process.wait()
            self._listener.join()
            last = self._error_lines[-1] if self._error_lines else f"its process ended with code {process.returncode}"
            raise InputError(f"{self.revision.name}: cannot be run: {last}")
        answer = json.loads(line)
        if "error" in answer:
            raise InputError(f"{self.revision.name}: cannot be run: {answer['error']}")
        if "skipped" in answer:
            raise WorkSkipped(answer["skipped"])
        return answer

    def prepare_work(self, command: str, **arguments: Any) -> PreparedWork:
        """Request the preparation of work; `revision_worker.py` lists the commands.

        Args:
            command: name of the request, such as `prepare_run`.
            arguments: its arguments except `positions`, which JSON can represent.

        Raises:
            InputError: with the worker's message, or if its process has ended.
            WorkSkipped: if the work lacks an input.
        """
        reply = self.send_request(command, positions=str(self._answer_path), **arguments)
        return PreparedWork(np.load(self._answer_path), reply["stats"], reply["clock"], reply.get("num_frames", 0))

    def count_instructions(self) -> int | None:
        """Count the instructions of one call of the work; None if the machine hides them."""
        return self.send_request("count_instructions")["instructions"]

    def time_calls(self, num_calls: int, clock: str) -> float:
        """Time calls of the work together.

        Args:
            num_calls: number of calls.
            clock: cpu or wall.

        Returns:
            Total time of the calls [s].
        """
        return self.send_request("time_calls", num_calls=num_calls, clock=clock)["seconds"]

    def rebuild_work(self) -> None:
        """Rebuild the prepared work at other addresses."""
        self.send_request("rebuild_work")

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

    def _read_errors(self) -> None:
        """Read standard error and store its last lines; a full pipe would block the process."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            if line.strip():
                self._error_lines.append(line.strip())


def _build_python_path(revision: GitRevision) -> str:
    """Build the Python path of a revision.

    The worktree's package and the worktree come first, so that the package installed with this interpreter is not
    timed instead. Existing entries follow, mapped from the checkout to the worktree.
    """
    given = [Path(entry).resolve() for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    mapped = [
        revision.worktree / entry.relative_to(revision.checkout)
        if revision.checkout and entry.is_relative_to(revision.checkout)
        else entry
        for entry in given
    ]
    package = [folder for folder in [revision.worktree / PACKAGE_FOLDER] if folder.is_dir()]
    return os.pathsep.join(map(str, dict.fromkeys([*package, revision.worktree, *mapped])))


@contextmanager
def start_workers(*revisions: GitRevision) -> Generator[list[RevisionProcess]]:
    """Start a worker process for each revision; all stop at the end of the block."""
    alive: list[RevisionProcess] = []
    with TemporaryDirectory(prefix="springbench-") as scratch:
        try:
            for number, side in enumerate(revisions):
                folder = Path(scratch) / str(number)
                folder.mkdir()
                alive.append(RevisionProcess(side, folder))
            yield alive
        finally:
            for worker in alive:
                worker.close()


INSTRUCTION_RTOL = 0.001
"""Relative tolerance of instruction counts, for internal work of the interpreter."""


def describe_changes(new: dict[str, int], old: dict[str, int]) -> list[str]:
    """Describe the differences of deterministic counts: iterations, entries, bytes, flops, instructions.

    Args:
        new: counts of this checkout.
        old: counts of the revision.

    Returns:
        One text per difference.
    """
    allowed = {name: INSTRUCTION_RTOL * old[name] if name == "instructions" else 0 for name in old}
    both = [name for name in old if name in new and abs(new[name] - old[name]) > allowed[name]]
    return [f"{name} {old[name]:,} -> {new[name]:,} ({new[name] / old[name] - 1:+.1%})" for name in both if old[name]]
