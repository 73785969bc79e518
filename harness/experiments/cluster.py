# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeArgument=false, reportUnknownParameterType=false
# Dask has no type annotations.
"""Execute runs on many machines with Dask.

Each run is a task in a separate process of a free worker.

A worker executes one run at a time. Workers of one machine wait for each other while one is timed
(`harness.base.machine_lock`). A run that crashes ends its process and not Dask's worker, so failed runs do not use
up the workers. The files of a run return with its outcome, except where the worker shares the client's folder. If a
worker is lost, its current run is repeated on another. A worker that cannot write or has other source code gets no more
runs.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic, sleep, time
from typing import Any, NamedTuple
from uuid import uuid4

import distributed
from distributed import Client, Future, KilledWorker
from distributed.utils import silence_logging_cmgr

from harness.base import machine
from harness.base.errors import InputError, Mistake, RunFailed
from harness.base.files import CannotWrite, replacing
from harness.base.progress import Display, Effort
from harness.base.workers import Limits, Lost, Tick, Workers
from harness.config.own import MOST
from harness.config.sweep import RunSpec
from harness.experiments.core import TABLES, ready, watched
from harness.experiments.plan import Files
from harness.experiments.run_unit import RunUnit
from harness.experiments.scheduler import PATIENCE, QUEUED, SILENCE, reach, scheduler
from solvers.plugins import Plugin, load

CLOCKS = 60.0
"""Difference between the clocks of a worker and the client above which a message is printed [s]."""

_TRIES = 4
"""Largest number of attempts for a run whose worker is lost."""

_GONE = "the scheduler is gone; what was done is kept, and the same command does the rest"

_ASK, _LOOK = 1.0, 0.05
"""Seconds between two queries of the workers; seconds between two queries of the tasks if none has finished."""

_AHEAD = 4
"""Tasks queued at the scheduler per worker thread; more would use its memory without benefit."""


class WorkerFacts(NamedTuple):
    """Machine, versions and clock of a worker."""

    machine: str
    node: str
    code: str
    python: str
    distributed: str
    clock: float

    @classmethod
    def this(cls) -> WorkerFacts:
        """Return the information about this process."""
        python = ".".join(map(str, sys.version_info[:2]))
        return cls(machine.describe().id, machine.node(), machine.code_hash(), python, version("distributed"), time())


class Done(NamedTuple):
    """Outcome of a run on a worker.

    Attributes:
        worker: address of the worker.
        told: outcome as text.
        left: content of the files that the run wrote, by name.
        useless: why this worker cannot execute runs; empty if it can.
    """

    worker: str
    told: str = ""
    left: Mapping[str, bytes] = {}
    useless: str = ""


class Cluster(NamedTuple):
    """Client of the workers, and the ids of their machines."""

    client: Client
    machines: Sequence[str]

    def do_all(
        self, folder: Path, display: Display, units: Sequence[RunUnit], another: Callable[[RunUnit], str]
    ) -> None:
        """Execute units on the workers (`do_on`)."""
        do_on(self.client, units, folder, display, another)


@contextmanager
def cluster(on: str, runs: Sequence[RunSpec], say: Callable[[str], None]) -> Generator[Cluster]:
    """Connect to the workers of a scheduler, and yield the cluster.

    Args:
        on: an address, a number of workers on this machine (`local:4`), or a file for a batch system.
        runs: runs to execute, whose plug-ins the workers must have.
        say: prints a remark.

    Raises:
        InputError: there is no scheduler, or no worker that can execute the runs.
    """
    with scheduler(on) as address:
        try:
            if isinstance(address, str):
                reach(address)
            client = Client(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            why = f"no scheduler answers within {PATIENCE:g} s ({' '.join(str(error).split())[:200]})"
            raise InputError(Mistake(f"{on}: {why}; start one with `dask scheduler`", key="--on")) from None
        # Dask's log would print tracebacks in addition to the message about a lost scheduler.
        with silence_logging_cmgr(SILENCE), client, client.as_current():
            for waits in range(0 if address is on else QUEUED, -1, -1):
                try:
                    client.wait_for_workers(1, timeout=PATIENCE)
                    break
                except TimeoutError:
                    if not waits:
                        why = f"the scheduler has no worker; start some with `dask worker {on} --nthreads 1`"
                        raise InputError(Mistake(f"{on}: {why}", key="--on")) from None
                    say(f"{on}: no worker has come yet")
            yield Cluster(client, machines(client, runs, say))


def machines(client: Client, runs: Sequence[RunSpec], say: Callable[[str], None]) -> list[str]:
    """Check all workers and return the ids of their machines; print which clocks differ.

    Args:
        client: Dask client.
        runs: runs whose plug-ins are required.
        say: prints a remark.

    Raises:
        InputError: a worker has other versions, or lacks a plug-in.
    """
    here = WorkerFacts.this()
    before = time()
    plugins = list({plugin for run in runs for plugin in run.own()})
    answered: Any = client.run(_about, plugins, on_error="return")
    found: dict[str, Any] = answered
    problems = []
    for worker, said in found.items():
        if isinstance(said, OSError):
            say(f"the worker {worker} was lost: {said}")
            continue
        if isinstance(said, BaseException):
            problems.append(f"the worker {worker} cannot do runs: {type(said).__name__}: {said}")
            continue
        about, missing = said
        for what in ("code", "python", "distributed"):
            theirs, ours = getattr(about, what), getattr(here, what)
            if theirs != ours:
                problems.append(f"the worker {worker} has another version: {what} {theirs}, here {ours}")
        problems += [f"the worker {worker} has no {name}: {why}" for name, why in missing.items()]
        off = about.clock - min(max(about.clock, before), time())
        if abs(off) > CLOCKS:
            say(f"the clock of {worker} is {abs(off):.0f} s {'ahead' if off > 0 else 'behind'}; its rows tell by it")
    if problems:
        raise InputError([Mistake(problem, key="--on") for problem in problems])
    answers = [said for said in found.values() if not isinstance(said, OSError)]
    if not answers:
        raise InputError(Mistake("all workers were lost; start others", key="--on"))
    return sorted({about.machine for about, _ in answers})


def _about(plugins: Sequence[Plugin]) -> tuple[WorkerFacts, dict[str, str]]:
    """On a worker: return its description, and why plug-ins cannot be imported."""
    missing = dict[str, str]()
    if plugins:
        _allow_children()
        process = Workers(fork=False)
        try:
            missing = process.do(partial(_missing, plugins), lambda _: None, Limits(*MOST))
        except Lost as lost:
            missing = {", ".join(plugins): f"the process that imports it {lost}"}
        finally:
            process.end()
    return WorkerFacts.this(), missing


def _missing(plugins: Sequence[Plugin], tick: Tick) -> dict[str, str]:
    missing = {}
    for plugin in plugins:
        try:
            load(plugin.target)
        except Exception as error:
            missing[str(plugin)] = f"{type(error).__name__}: {error}"
    return missing


def _allow_children() -> None:
    """Allow child processes: Dask's nannies start workers as daemons, which may have none.

    The children end with their parent.
    """
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]


def do_on(
    client: Client,
    units: Sequence[RunUnit],
    folder: Path,
    display: Display,
    another: Callable[[RunUnit], str] = lambda unit: "",
) -> None:
    """Execute units on the workers of a client; their files are written to `folder`.

    Args:
        client: Dask client.
        units: runs to execute.
        folder: folder of the sweep.
        display: shows progress.
        another: returns why another command has a unit, or an empty string (`do_together`).

    Raises:
        InputError: the input is invalid.
        CannotWrite: no worker can write any more.
        RunFailed: the connection to the scheduler is lost.
    """
    token = folder / "rows" / f".{uuid4().hex}.partial"  # who sees it shares the folder; it goes as such files do
    left, tries, excluded = list(enumerate(units))[::-1], dict[int, int](), set[str]()
    threads, asked = dict[str, int](), 0.0
    going: dict[Future, tuple[int, RunUnit]] = {}
    fixed = folder.resolve(), f"rows/{token.name}", machine.code_hash(), [dict(table) for table in TABLES]
    display.begin([unit.effort for unit in units])
    looks = display.run(
        f"{len(units)} runs on {client.scheduler.address if client.scheduler else 'a cluster'}", 1, Effort(amount=0.0)
    )
    try:
        token.touch()
        while left or going:
            if not threads or monotonic() - asked > _ASK:
                threads, asked = _threads(client), monotonic()
            workers = {name: many for name, many in threads.items() if name not in excluded}
            while left and len(going) < _AHEAD * max(1, sum(workers.values())):
                number, unit = left.pop()
                if why := another(unit):
                    display.elsewhere(unit.title, unit.effort, why)
                    continue
                key = f"springbench-{unit.run.title.replace(' ', '-')}-{uuid4().hex}"
                only = list(workers) if excluded and workers else None
                task = client.submit(_do, unit, *fixed, key=key, pure=False, workers=only)
                going[task] = number, unit
            ended = [task for task in going if task.done()]
            if not ended:
                sleep(_LOOK)
            looks.tick("")
            answers = _answers(client, ended)
            for task in ended:
                number, unit = going.pop(task)
                last = tries.get(number, 1) >= _TRIES
                again = _ended(task, answers.get(task), unit, folder, display, excluded, last=last)
                if again:
                    tries[number] = tries.get(number, 1) + 1
                    left.append((number, unit))
            if excluded and not set(_threads(client)) - excluded:
                raise CannotWrite(f"no worker is of use any more: {', '.join(sorted(excluded))}")
    finally:
        token.unlink(missing_ok=True)
        display.end()


def _answers(client: Client, ended: Sequence[Future]) -> dict[Future, Done]:
    """Fetch the outcomes of finished tasks together.

    Failed tasks are left out; the result is empty if a worker was lost meanwhile.
    """
    finished = [task for task in ended if task.status == "finished"]
    try:
        found: Any = client.gather(finished)
    except (KilledWorker, CancelledError):
        return {}
    except OSError:
        raise RunFailed(_GONE) from None
    return dict(zip(finished, found, strict=True))


def _ended(
    task: Future,
    answer: Done | None,
    unit: RunUnit,
    folder: Path,
    display: Display,
    excluded: set[str],
    *,
    last: bool,
) -> bool:
    """Store the files of a finished task, and return whether to repeat its run.

    `answer` is the result if it has been fetched already; `last` excludes another attempt.
    """
    if task.status in ("cancelled", "lost"):
        raise RunFailed(_GONE)
    run = display.run(unit.title, 1, unit.effort)
    try:
        done: Done = answer or task.result()
    except KilledWorker as error:
        if last:
            run.finished(unit.lost(Lost("killed", f"its worker was lost again and again: {error}")))
        return not last
    if done.useless:
        excluded.add(done.worker)
        run.finished(f"is done elsewhere, for {done.worker} {done.useless}")
        return True
    for name, content in sorted(done.left.items(), key=lambda item: item[0].endswith(".parquet")):  # rows last
        with replacing(folder / name) as partial_name:
            partial_name.write_bytes(content)
    run.finished(done.told)
    return False


def _threads(client: Client) -> dict[str, int]:
    """Return the number of threads of each worker. Raises RunFailed."""
    try:
        found: Any = client.nthreads()
    except OSError:
        raise RunFailed(_GONE) from None
    return found


_PROCESSES: list[Workers] = []
"""Idle processes of this worker, which wait for their next run."""


def _do(unit: RunUnit, folder: Path, token: str, code: str, tables: Sequence[Mapping[str, str]]) -> Done:
    """On a worker: execute one run in a separate process."""
    me = distributed.get_worker().address
    if machine.code_hash() != code:
        return Done(me, useless=f"has other code, {machine.code_hash()} and not {code}")
    _allow_children()
    process = _PROCESSES.pop() if _PROCESSES else Workers(partial(ready, tables), fork=False)
    try:
        with TemporaryDirectory(prefix="springbench-") as temporary:
            shared = (folder / token).exists()
            place = folder if shared else Path(temporary)
            for part in ("rows", "recordings", "pictures"):
                (place / part).mkdir(exist_ok=True)
            here = RunUnit(unit.run, Files.of(unit.run, place), None, unit.at_once)
            try:
                told = process.do(partial(watched, here), lambda _: None, here.limits)
            except Lost as lost:
                told = here.lost(lost)
            made = [] if shared else [here.files.rows, here.files.recording]
            return Done(me, told, {os.path.relpath(path, place): path.read_bytes() for path in made if path.exists()})
    except (CannotWrite, OSError) as error:
        return Done(me, useless=f"cannot write: {error}")
    finally:
        _PROCESSES.append(process)
