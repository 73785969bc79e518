"""Which workers can do runs elsewhere is reported before any starts, and why another cannot."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from time import time
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from springbench.harness.config.sweep_config import RunSpec
from springbench.harness.errors import InputError
from springbench.harness.experiments import dask_cluster
from springbench.harness.experiments.dask_cluster import WorkerInfo
from springbench.solvers.plugins.plugin_discovery import PluginName


class Workers:
    """A client whose workers say this."""

    def __init__(self, *said: object) -> None:
        self._said = {f"tcp://worker-{number}:1": what for number, what in enumerate(said)}

    def run(self, function: Callable[..., Any], *arguments: object, on_error: str) -> dict[str, object]:
        return {name: function(*arguments) if what is None else what for name, what in self._said.items()}


class UserCodeRun(NamedTuple):
    """A run with user code."""

    plugins: tuple[PluginName, ...]

    def find_plugins(self) -> list[PluginName]:
        return list(self.plugins)


def machines(client: Workers, *plugins: PluginName, say: Callable[[str], None] = print) -> list[str]:
    runs: Any = [UserCodeRun(plugins)]
    requested: Any = client
    return dask_cluster.check_workers(requested, list[RunSpec](runs), say)


def test_workers_like_this_one_can_do_runs():
    assert machines(Workers(None, None)) == [WorkerInfo.from_this_process().machine_id]


@pytest.mark.parametrize(
    ("field", "title"),
    [("source_fingerprint", "source code"), ("python_version", "Python"), ("dask_version", "distributed")],
)
def test_a_worker_of_another_version_is_refused_with_both(field: str, title: str):
    other = WorkerInfo.from_this_process()._replace(**{field: "0.0.1"})
    with pytest.raises(InputError) as refused:
        machines(Workers(None, (other, {})))
    for part in ("tcp://worker-1:1", f"{title} 0.0.1", str(getattr(WorkerInfo.from_this_process(), field))):
        assert part in str(refused.value)
    assert "worker-0" not in str(refused.value)


def test_a_worker_without_a_plug_in_is_named_with_it(tmp_path: Path):
    mine = PluginName("./mine.py:Mine", f"{tmp_path}/mine.py:Mine", "mine", "1", "")
    with pytest.raises(InputError) as refused:
        machines(Workers(None), mine)
    assert "worker-0" in str(refused.value)
    assert "./mine.py:Mine" in str(refused.value)


def test_a_worker_that_does_not_respond_is_reported():
    with pytest.raises(InputError, match=r"worker-0.*ModuleNotFoundError.*harness"):
        machines(Workers(ModuleNotFoundError("No module named 'harness'")))


def test_a_worker_that_is_lost_meanwhile_is_no_mistake():
    messages: list[str] = []
    assert machines(Workers(None, OSError("Stream is closed")), say=messages.append) == [
        WorkerInfo.from_this_process().machine_id
    ]
    assert "worker-1" in messages[0]
    with pytest.raises(InputError, match="all workers were lost"):
        machines(Workers(OSError("Stream is closed")))


@pytest.mark.parametrize(("off", "words"), [(3600.0, "ahead"), (-3600.0, "behind"), (1.0, "")])
def test_clocks_that_differ_are_reported(off: float, words: str):
    messages: list[str] = []
    machines(Workers((WorkerInfo.from_this_process()._replace(clock_seconds=time() + off), {})), say=messages.append)
    assert [words in line for line in messages] == [True] * bool(words)


@pytest.mark.parametrize(
    ("on", "said"),
    [
        ("tcp://127.0.0.1:1", "no scheduler answers"),
        ("nowhere", "no scheduler answers"),
        ("local:none", "expected local:N"),
        ("absent.yaml", "expected a mapping"),
    ],
)
def test_a_missing_cluster_is_reported(on: str, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(dask_cluster, "CONNECT_TIMEOUT", 0.3)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=said), dask_cluster.connect_cluster(on, [], print):
        pass


@pytest.mark.parametrize(
    ("described", "said"),
    [
        ("{kind: HAND, jobs: 2}", "this machine has no submit-by-hand"),
        ("{kind: OTHER, jobs: 2}", "dask-jobqueue has no OTHERCluster"),
        ("{kind: HAND}", "expected a mapping"),
    ],
)
def test_a_missing_batch_system_is_reported(described: str, said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    hand = SimpleNamespace(job_cls=SimpleNamespace(submit_command="submit-by-hand --now"))
    monkeypatch.setitem(sys.modules, "dask_jobqueue", SimpleNamespace(HANDCluster=hand))
    (tmp_path / "batch.yaml").write_text(described)
    with pytest.raises(InputError, match=said), dask_cluster.connect_cluster(str(tmp_path / "batch.yaml"), [], print):
        pass
