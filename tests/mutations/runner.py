"""Plants one error after the other in a copy of the sources and runs the tests of which one must fail.

Compiled code is cached by the content of its sources, so only the kernels that an error changes are compiled again.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from time import monotonic

from tests.mutations.base import ROOT, Mutation

FOLDERS = (".src", "harness", "solvers", "configs", "tests", "results", ".github")
SOURCES = (*FOLDERS, "pyproject.toml", "README.md", "CITATION.cff")
OUTCOMES = Path(__file__).with_name("outcomes.json")
TEST_SECONDS, SUITE_SECONDS = 900.0, 3600.0
"""Wall-clock limits [s] of an error's own tests and of the whole suite. A time-out decides nothing: a busy machine is
slow too."""
PYTEST = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", "-m", "not long")
"""Command of a file of tests or of the suite; a test that is named itself is run even if it is long."""
TEST_FOLDERS = ("architecture", "unit", "oracles", "contracts", "stability", "bench")
"""All tests, the short ones first: the suite ends with the first that the error makes fail."""
IGNORED_TESTS = "--ignore=tests/unit/test_mutations.py"
"""Tests of the table fail for any planted error, because its entry no longer fits: they catch nothing."""
MAX_FAILURES = 5
"""Failures after which the whole suite ends: some are by chance, and each restart costs minutes."""
CAUGHT, SURVIVED, BROKEN, TIMED_OUT, SKIPPED = "caught", "survived", "broken", "timed out", "skipped"
_TIME_OUT_CODE = -1


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of an error.

    tests, product: how its tests and the run of the product ended, `product` empty if none is needed; seconds: of
    both; entry, sources: digests of the table's entry and of the sources; failed: the first test that failed.
    """

    name: str
    tests: str
    product: str
    seconds: float
    entry: str
    sources: str
    failed: str = ""

    @property
    def is_caught(self) -> bool:
        """Whether a test failed, and the product detected it if it must."""
        return self.tests == CAUGHT and self.product in ("", CAUGHT)

    @property
    def is_decided(self) -> bool:
        """Whether nothing timed out, and the tests were not all skipped, as without a browser."""
        return self.tests != SKIPPED and TIMED_OUT not in (self.tests, self.product)


def digest_sources(mutation: Mutation, *, whole: bool = False) -> str:
    """A digest of all that an outcome depends on: the product, the helpers of tests, and the error's own test files.

    whole: all test files instead. The table is left out; its entries have digests of their own.
    """
    own = {ROOT / test.partition("::")[0] for test in mutation.tests}
    digest = hashlib.sha256()
    for path, content in _read_sources():
        if whole or path in own or not path.name.startswith("test_"):
            digest.update(content)
    return digest.hexdigest()[:12]


@cache
def _read_sources() -> list[tuple[Path, bytes]]:
    """All Python files but the table's, with the digests of their names and contents."""
    paths = (path for part in ("harness", "solvers", "tests") for path in sorted((ROOT / part).rglob("*.py")))
    return [
        (path, hashlib.sha256(path.relative_to(ROOT).as_posix().encode() + path.read_bytes()).digest())
        for path in paths
        if path.parent != OUTCOMES.parent
    ]


def read_outcomes() -> dict[str, Outcome]:
    """The stored outcomes by name, with ` whole` appended for those of the whole suite."""
    if not OUTCOMES.exists():
        return {}
    return {key: Outcome(**fields) for key, fields in json.loads(OUTCOMES.read_text()).items()}


def store_outcome(key: str, outcome: Outcome) -> None:
    """Add one outcome to the stored ones; the file is replaced at once, so a kill cannot damage it."""
    outcomes = {name: asdict(known) for name, known in (read_outcomes() | {key: outcome}).items()}
    partial = OUTCOMES.with_name(f".{OUTCOMES.name}.partial")
    partial.write_text(json.dumps(dict(sorted(outcomes.items())), indent=1) + "\n")
    os.replace(partial, OUTCOMES)


class SourceCopy:
    """A copy of the sources in a folder, in which errors are planted."""

    def __init__(self, folder: Path) -> None:
        self._root, self._compiled, self._num_planted = folder / "sources", folder / "compiled", 0
        self._root.mkdir(parents=True)
        ignored = shutil.ignore_patterns("__pycache__", ".*", "*.rrd", "*.parquet")
        for name in SOURCES:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, self._root / name, symlinks=True, ignore=ignored)
            else:
                shutil.copy2(source, self._root / name)

    @contextmanager
    def plant_mutation(self, mutation: Mutation) -> Iterator[None]:
        """Plant an error; afterwards its file is as before, its times included. Raises StaleMutation.

        Each planting has a time of modification of its own [whole seconds]: Python takes bytecode for up to date by the
        source's time and length, and the error may leave the length as it is.
        """
        path = self._root / mutation.file
        text, times = path.read_bytes(), path.stat()
        path.write_text(mutation.apply(self._root))
        self._num_planted += 1
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns + self._num_planted * 10**9))
        try:
            yield
        finally:
            path.write_bytes(text)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))

    def run_command(self, mutation: Mutation, command: list[str], limit: float) -> tuple[int, str]:
        """Run a Python command in the copy; returns its exit code and output, or -1 after `limit` seconds."""
        environment = {"NUMBA_CACHE_DIR": str(self._compiled)} | os.environ
        environment |= {
            "PYTHONPATH": os.pathsep.join((str(self._root / ".src"), str(self._root))),
            "PYTHONDONTWRITEBYTECODE": "",  # bytecode saves half of the time of most errors
        }
        if any(test.startswith("tests/cuda/") for test in mutation.tests):
            environment["NUMBA_ENABLE_CUDASIM"] = "1"
        process = subprocess.Popen(
            [sys.executable, *command],
            cwd=self._root,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        try:
            output, _ = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # workers of a hanging test too
            process.communicate()
            return _TIME_OUT_CODE, ""
        return process.returncode, output


def select_named(tests: Sequence[str]) -> tuple[str, ...]:
    """Return the options that select long tests too, if all are named themselves."""
    return ("-m", "") if all("::" in test for test in tests) else ()


def _run_tests(
    copy: SourceCopy, mutation: Mutation, tests: Sequence[str], limit: float, max_failures: int = 1
) -> tuple[int, list[str]]:
    """Run tests with an error planted; returns the exit code and the tests that failed, or the last line of output."""
    with copy.plant_mutation(mutation):
        command = [*PYTEST, *select_named(tests), f"--maxfail={max_failures}", *tests]
        code, output = copy.run_command(mutation, command, limit)
    lines = output.splitlines()
    failures = [line.removeprefix("FAILED ").split(" - ")[0] for line in lines if line.startswith("FAILED ")]
    return code, failures or lines[-1:] or [""]


def _fails_by_error(copy: SourceCopy, mutation: Mutation, test: str) -> bool:
    """Whether a test fails with the error once more, and passes without it: otherwise it failed by chance."""
    with_error, _ = _run_tests(copy, mutation, [test], TEST_SECONDS)
    without, _ = copy.run_command(mutation, [*PYTEST, *select_named([test]), test], TEST_SECONDS)
    return with_error == 1 and without == 0


def _run_suite(copy: SourceCopy, mutation: Mutation) -> tuple[int, str]:
    """The exit code of the whole suite and the first test that the error makes fail."""
    by_chance: list[str] = []
    while True:
        others = [IGNORED_TESTS, *(f"--deselect={test}" for test in by_chance)]
        chosen = [*(f"tests/{folder}" for folder in TEST_FOLDERS), *others]
        code, failed = _run_tests(copy, mutation, chosen, SUITE_SECONDS, MAX_FAILURES)
        if code != 1:
            return code, failed[0]
        for test in failed:
            if _fails_by_error(copy, mutation, test):
                return code, test
        by_chance += failed


def examine(
    copy: SourceCopy, mutation: Mutation, sources: str, *, whole: bool = False, failed_before: str = ""
) -> Outcome:
    """Plant an error, and find out whether tests and product catch it. Raises StaleMutation.

    failed_before: the test that caught it last time; of the error's own tests it is run first.
    """
    began = monotonic()
    if whole:
        code, failed = _run_suite(copy, mutation)
    else:
        code, failed = _run_own_tests(copy, mutation, failed_before)
    tests = {0: SURVIVED, 1: CAUGHT, _TIME_OUT_CODE: TIMED_OUT}.get(code, BROKEN)
    if tests == SURVIVED and " passed" not in failed:
        tests = SKIPPED
    product = "" if whole else _examine_product(copy, mutation)
    return Outcome(mutation.name, tests, product, round(monotonic() - began, 1), mutation.digest, sources, failed)


def _run_own_tests(copy: SourceCopy, mutation: Mutation, failed_before: str) -> tuple[int, str]:
    """The exit code of an error's own tests and the first that failed."""
    if failed_before.startswith(mutation.tests):
        code, failed = _run_tests(copy, mutation, [failed_before], TEST_SECONDS)
        if code == 1:
            return code, failed[0]
    code, failed = _run_tests(copy, mutation, mutation.tests, TEST_SECONDS)
    return code, failed[0]


def _examine_product(copy: SourceCopy, mutation: Mutation) -> str:
    """Whether a run of the product detects an error by itself; empty if it need not."""
    if not mutation.product:
        return ""
    solver, reason = mutation.product
    with copy.plant_mutation(mutation):
        code, output = copy.run_command(mutation, ["-m", "tests.mutations.product", solver], TEST_SECONDS)
    if code == _TIME_OUT_CODE:
        return TIMED_OUT
    return CAUGHT if "failed:" in output and reason in output else SURVIVED
