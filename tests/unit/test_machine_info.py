"""The machine, the versions, the commit, the hash of the code, and the pinned threads."""

import os
import platform
import re
import socket
import subprocess
import sys
from dataclasses import astuple, replace
from pathlib import Path

import psutil
import pytest
from springbench.harness.errors import InputError
from springbench.harness.execution import machine_info
from threadpoolctl import threadpool_info

CORES = machine_info.describe_machine().cores


def git(folder: Path, *arguments: str) -> str:
    """What git says in the folder, as a user without any configuration of their own."""
    identity = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A git checkout with one committed source."""
    (tmp_path / "harness").mkdir()
    (tmp_path / "harness" / "one.py").write_text("x = 1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "harness")
    git(tmp_path, "commit", "-q", "-m", "One")
    return tmp_path


def test_the_machine_is_described():
    here = machine_info.describe_machine()
    assert here.cpu.strip() == here.cpu != ""
    assert 1 <= here.cores <= (os.cpu_count() or 1)
    assert 0.1 < here.memory_gib < 1e5
    assert platform.system() in here.operating_system
    assert here == machine_info.describe_machine()


def test_the_description_of_the_machine_omits_its_host_name():
    name = re.compile(rf"\b{re.escape(socket.gethostname())}\b")
    assert not [value for value in astuple(machine_info.describe_machine()) if name.search(str(value))]


def test_the_id_depends_on_processor_cores_and_memory_alone():
    here = machine_info.MachineInfo(cpu="a processor", cores=2, memory_gib=23.5, operating_system="a system")
    assert re.fullmatch(r"[0-9a-f]{12}", here.machine_id)
    assert replace(here, operating_system="another").machine_id == here.machine_id
    assert (
        replace(here, memory_gib=23.6).machine_id == here.machine_id
    )  # firmware updates change the memory by less than 1 GiB
    others = [replace(here, cpu="another"), replace(here, cores=4), replace(here, memory_gib=64.0)]
    assert len({here.machine_id, *(other.machine_id for other in others)}) == 4


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system has no affinity of processes")
def test_the_cores_are_those_that_the_process_may_use():
    code = "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]); "
    code += "from springbench.harness.execution import machine_info; print(machine_info.describe_machine().cores)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout == b"1\n"


def test_the_versions_name_python_and_the_numeric_libraries():
    found = machine_info.collect_versions()
    assert found["python"] == platform.python_version()
    assert {"numpy", "scipy", "numba"} <= found.keys()
    assert all(re.match(r"\d+\.\d+", version) for version in found.values())


def test_a_clean_checkout_gives_its_commit(checkout: Path):
    assert machine_info.read_commit(checkout) == git(checkout, "rev-parse", "HEAD")


def test_a_tag_does_not_hide_the_commit(checkout: Path):
    git(checkout, "tag", "-a", "v1", "-m", "one")
    assert machine_info.read_commit(checkout) == git(checkout, "rev-parse", "HEAD")


def test_a_changed_file_makes_the_commit_dirty(checkout: Path):
    (checkout / "harness" / "one.py").write_text("x = 2\n")
    assert machine_info.read_commit(checkout) == git(checkout, "rev-parse", "HEAD") + "-dirty"


def test_a_folder_inside_a_foreign_checkout_has_an_unknown_commit(checkout: Path):
    assert machine_info.read_commit(checkout / "harness") == "unknown"


def test_without_git_the_commit_is_unknown(checkout: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", str(checkout))
    assert machine_info.read_commit(checkout) == "unknown"


def test_the_commit_is_the_projects_wherever_the_process_was_started(checkout: Path, monkeypatch: pytest.MonkeyPatch):
    foreign = git(checkout, "rev-parse", "HEAD")
    monkeypatch.chdir(checkout)
    monkeypatch.setenv("GIT_DIR", str(checkout / ".git"))
    machine_info.read_commit.cache_clear()
    assert foreign not in machine_info.read_commit()


def test_the_code_hash_follows_names_and_contents_of_the_sources(tmp_path: Path):
    seen = []
    for number, (name, text) in enumerate([("a", "x = 1"), ("a", "x = 2"), ("b", "x = 1"), ("a", "")]):
        root = tmp_path / str(number)
        for package in ("harness", "solvers"):
            (root / package).mkdir(parents=True)
        (root / "solvers" / f"{name}.py").write_text(text)
        seen.append(machine_info.hash_sources(root))
        (root / "solvers" / "notes.txt").write_text("not a source")
        machine_info.hash_sources.cache_clear()
        assert machine_info.hash_sources(root) == seen[-1]
    assert len(set(seen)) == 4
    assert all(re.fullmatch(r"[0-9a-f]{12}", each) for each in seen)


THREAD_PROGRAM = """
from springbench.harness.execution.machine_info import limit_threads
from threadpoolctl import threadpool_info
with limit_threads({threads}):
    import numba, numpy, scipy.linalg
    print(numba.get_num_threads(), *[p["num_threads"] for p in threadpool_info() if p["user_api"] == "blas"])
"""


@pytest.mark.parametrize("threads", sorted({1, CORES}))
def test_pinned_threads_apply_to_numba_and_every_blas(threads: int):
    # A fresh process, in which neither NumPy nor SciPy was loaded before the threads were pinned.
    completed = subprocess.run(
        [sys.executable, "-c", THREAD_PROGRAM.format(threads=threads)], capture_output=True, text=True, check=True
    ).stdout.split()
    assert len(completed) >= 2
    assert set(completed) == {str(threads)}


def test_pinned_threads_are_restored_even_after_a_failure():
    # Imported first: a BLAS that is loaded inside would not have been there before.
    import numba
    import scipy.linalg  # noqa: F401

    def now() -> list[int]:
        return [numba.get_num_threads(), *(pool["num_threads"] for pool in threadpool_info())]

    def fail() -> None:
        with machine_info.limit_threads(1):
            assert numba.get_num_threads() == 1
            raise ZeroDivisionError

    before = now()
    with pytest.raises(ZeroDivisionError):
        fail()
    assert now() == before


@pytest.mark.parametrize("threads", [0, -1, CORES + 1])
def test_more_threads_than_usable_cores_are_the_users_mistake(threads: int):
    with pytest.raises(InputError, match=rf"from 1 to {CORES}, .* not {threads}"), machine_info.limit_threads(threads):
        pass


@pytest.fixture
def set_core_loads(monkeypatch: pytest.MonkeyPatch):
    """Says how busy four cores are [%]; what was found of them is forgotten before and after."""

    def pretend(*busy: float) -> None:
        monkeypatch.setattr(machine_info, "_count_usable_cores", lambda: 4)
        monkeypatch.setattr(machine_info.os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
        monkeypatch.setattr(psutil, "cpu_percent", lambda _, percpu: list(busy))

    def forget() -> None:
        machine_info._count_idle_cores.cache_clear()
        machine_info.start_load_sample.cache_clear()

    forget()
    yield pretend
    forget()


@pytest.mark.parametrize(
    ("busy", "number"),
    [((0, 0, 0, 0), 4), ((2, 1, 5, 3), 4), ((100, 0, 0, 0), 3), ((50, 50, 50, 50), 2), ((100, 100, 100, 90), 1)],
)
def test_threads_are_as_many_as_there_are_idle_cores(set_core_loads, busy: tuple[float, ...], number: int):
    set_core_loads(*busy)
    found = machine_info.choose_threads("auto")
    assert found.count == number
    assert f"{number} of 4" in found.reason


def test_the_work_of_this_process_during_the_sample_is_no_load(set_core_loads, monkeypatch: pytest.MonkeyPatch):
    set_core_loads(100, 0, 0, 100)
    monkeypatch.setattr(machine_info, "process_time", machine_info.perf_counter)  # it computes all the time
    machine_info.start_load_sample()
    assert machine_info.choose_threads("auto").count == 3


def test_a_sample_that_started_early_enough_delays_nothing(set_core_loads, monkeypatch: pytest.MonkeyPatch):
    set_core_loads(0, 0, 0, 0)
    waits = list[float]()
    monkeypatch.setattr(machine_info, "sleep", waits.append)
    began, _ = machine_info.start_load_sample()
    monkeypatch.setattr(machine_info, "perf_counter", lambda: began + 10.0)
    machine_info.choose_threads("auto")
    assert waits == [0.0]


def test_a_number_that_was_given_stays(set_core_loads):
    set_core_loads(100, 100, 100, 100)
    assert machine_info.choose_threads(3) == machine_info.ThreadChoice(3)


def test_the_choice_stays_the_same_all_the_process_long(set_core_loads):
    set_core_loads(0, 0, 0, 0)
    first = machine_info.choose_threads("auto")
    set_core_loads(100, 100, 100, 100)
    assert machine_info.choose_threads("auto") is first
