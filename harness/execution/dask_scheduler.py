# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# Dask and ruamel.yaml have no type annotations.
"""Dask scheduler: remote, on this machine, or on a batch system described by a file."""

from __future__ import annotations

import logging
from collections.abc import Generator
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import resource_tracker
from pathlib import Path
from shutil import which
from socket import create_connection
from typing import Any
from urllib.parse import urlsplit

from dask import config
from distributed import LocalCluster
from distributed.security import Security
from ruamel.yaml import YAML
from springbench.harness.errors import InputError, InputMistake
from springbench.harness.execution.interrupts import block_interrupts

CONNECT_TIMEOUT = 10.0
"""Time in which a scheduler must respond and have a worker [s]."""

MAX_QUEUE_WAITS = 60
"""Number of periods of CONNECT_TIMEOUT that the first job of a batch system may wait in the queue."""

DASK_LOG_LEVEL = logging.CRITICAL
"""Log level that suppresses Dask's messages about ended workers, because the outcome of each run is reported."""


@contextmanager
def open_scheduler(scheduler_address: str) -> Generator[Any]:
    """Yield the given address, or a cluster that runs as long as the context.

    A local cluster accepts TLS connections only, with a certificate that its processes store in memory. Any client of a
    scheduler can execute code, and the loopback interface is open to all users of the machine. The HTTP servers have no
    authentication and therefore serve no pages.

    Raises:
        InputError: the address or the file of the batch system is invalid, or a package is missing.
    """
    kind, _, many = scheduler_address.partition(":")
    if kind == "local":
        if not many.isdecimal() or not 1 <= int(many) <= 1024:
            raise InputError(
                InputMistake(f"got {scheduler_address}; expected local:N with a number of workers", key="--scheduler")
            )
        try:
            secure = Security.temporary()
        except ImportError:
            raise InputError(
                InputMistake("needs cryptography: pip install 'springbench[cluster]'", key="--scheduler")
            ) from None
        quiet: Any = {"dashboard_address": None, "silence_logs": DASK_LOG_LEVEL}
        with config.set({"distributed.scheduler.http.routes": [], "distributed.worker.http.routes": []}):
            resource_tracker.ensure_running()
            with block_interrupts():  # only this process receives Ctrl-C, and ends the workers
                cluster = LocalCluster(n_workers=int(many), threads_per_worker=1, security=secure, **quiet)
            with cluster as found:
                yield found
    elif scheduler_address.endswith((".yaml", ".yml")):
        with _start_batch_cluster(Path(scheduler_address)) as found:
            yield found
    else:
        yield scheduler_address


def check_address(address: str) -> None:
    """Raise OSError or ValueError if no server listens at an address.

    Dask's client would retry without end.
    """
    place = urlsplit(address)
    if not place.hostname or not place.port:
        raise ValueError("an address is like tcp://host:8786")
    create_connection((place.hostname, place.port), timeout=CONNECT_TIMEOUT).close()


def _start_batch_cluster(path: Path) -> Any:
    """Start the cluster that a file describes.

    `kind` is a class name of dask-jobqueue without "Cluster", `jobs` the number of jobs; the rest are its options.
    """
    try:
        options = dict(YAML(typ="safe").load(path.read_text()) or {})
        kind, jobs = str(options.pop("kind")), int(options.pop("jobs"))
    except (OSError, TypeError, ValueError, KeyError) as error:
        expected = (
            "expected a mapping with `kind` (SLURM, PBS, ...), `jobs` and the options of that dask-jobqueue cluster"
        )
        raise InputError(InputMistake(f"cannot be read ({error}); {expected}", path)) from None
    try:
        dask_jobqueue = import_module("dask_jobqueue")
    except ModuleNotFoundError:
        raise InputError(InputMistake("needs dask-jobqueue: pip install 'springbench[cluster]'", path)) from None
    made = getattr(dask_jobqueue, f"{kind}Cluster", None)
    if made is None:
        raise InputError(InputMistake(f"{kind}: dask-jobqueue has no {kind}Cluster", path, key="kind"))
    submit = str(getattr(made.job_cls, "submit_command", "")).partition(" ")[0]
    if submit and not which(submit):
        why = f"{kind}: this machine has no {submit}; start the command where jobs can be submitted"
        raise InputError(InputMistake(why, path, key="kind"))
    try:
        found = made(**options)
    except (TypeError, ValueError) as error:
        raise InputError(InputMistake(f"{kind}Cluster reports: {error}", path)) from None
    found.scale(jobs=jobs)
    return found
