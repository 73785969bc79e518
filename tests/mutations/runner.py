"""Plants one lie after the other in a copy of the sources and runs the tests that must fail.

The copy stays in one place, so that code which a lie cannot have changed is compiled once; where it can have, compiled
code goes to a folder of the lie's own.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from tests.mutations.base import ROOT, Mutation

FOLDERS = (".src", "harness", "solvers", "configs", "tests", "results", ".github")
SOURCES = (*FOLDERS, "pyproject.toml", "README.md", "CITATION.cff")
OUTCOMES = Path(__file__).with_name("outcomes.json")
LONGEST = 600.0
"""Seconds after which tests count as hanging, which is noticed too."""
WHOLE = 3600.0
PYTEST = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", "-m", "not long")
ROOMS = ("architecture", "unit", "oracles", "contracts", "stability", "bench")
"""All tests, the short ones first: the suite ends with the first that the lie makes fail."""
OF_THE_TABLE = "--ignore=tests/unit/test_mutations.py"
"""Its tests fail where any lie is planted, for its entry then fits no more: they find nothing out."""
FEW = 5
"""Failures after which the whole suite ends: chance is behind some of them, and each start over costs minutes."""
CAUGHT, SURVIVED, BROKEN = "caught", "survived", "broken"


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a lie: by its tests, or by all of them; by the product, empty where it need not; seconds; the
    digests of the table's entry and of the sources; the first test that failed."""

    name: str
    tests: str
    product: str
    seconds: float
    entry: str
    sources: str
    failed: str = ""

    @property
    def found_out(self) -> bool:
        """Whether all who must have found it out have."""
        return self.tests == CAUGHT and self.product in ("", CAUGHT)


def sources() -> str:
    """A digest of what is planted in, and of the tests; not of this table, whose entries have their own."""
    digest = hashlib.sha256()
    for part in ("harness", "solvers", "tests"):
        for path in sorted((ROOT / part).rglob("*.py")):
            if path.parent != OUTCOMES.parent:
                digest.update(path.relative_to(ROOT).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def known() -> dict[str, Outcome]:
    """The outcomes that are kept, by `name`, with ` whole` behind it for those of the whole suite."""
    if not OUTCOMES.exists():
        return {}
    return {key: Outcome(**found) for key, found in json.loads(OUTCOMES.read_text()).items()}


def keep(key: str, outcome: Outcome) -> None:
    """Add one to those that are kept; a kill leaves the file as it was, or with it."""
    fields = {name: getattr(outcome, name) for name in Outcome.__slots__}
    found = {name: {field: getattr(o, field) for field in Outcome.__slots__} for name, o in known().items()}
    partial = OUTCOMES.with_name(f".{OUTCOMES.name}.partial")
    partial.write_text(json.dumps(dict(sorted((found | {key: fields}).items())), indent=1) + "\n")
    os.replace(partial, OUTCOMES)


class Copy:
    """A copy of the sources in a folder; lies are planted there."""

    def __init__(self, folder: Path) -> None:
        self._root, self._compiled = folder / "sources", folder / "compiled"
        self._own = folder / "own"
        self._root.mkdir(parents=True)
        ignored = shutil.ignore_patterns("__pycache__", ".*", "*.rrd", "*.parquet")
        for name in SOURCES:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, self._root / name, symlinks=True, ignore=ignored)
            else:
                shutil.copy2(source, self._root / name)

    @contextmanager
    def planted(self, lie: Mutation) -> Iterator[None]:
        """With the lie in its file, which is then as it was, its time included. Raises Stale."""
        path = self._root / lie.file
        text, times = path.read_bytes(), path.stat()
        path.write_text(lie.applied(self._root))
        try:
            yield
        finally:
            path.write_bytes(text)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
            shutil.rmtree(self._own, ignore_errors=True)

    def run_command(self, lie: Mutation, command: list[str], limit: float) -> tuple[int, str]:
        """The exit code of a Python command in the copy, and what it printed; -1 where it takes too long."""
        cache = self._own if lie.compiled else self._compiled
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join((str(self._root / ".src"), str(self._root))),
            "NUMBA_CACHE_DIR": str(cache),
            "PYTHONDONTWRITEBYTECODE": "1",  # a lie and the truth may have one length, and one second
        }
        if any(test.startswith("tests/cuda/") for test in lie.tests):
            environment["NUMBA_ENABLE_CUDASIM"] = "1"
        try:
            done = subprocess.run(
                [sys.executable, *command],
                cwd=self._root,
                env=environment,
                capture_output=True,
                text=True,
                timeout=limit,
            )
        except subprocess.TimeoutExpired:
            return -1, ""
        return done.returncode, done.stdout + done.stderr


def _run(copy: Copy, lie: Mutation, chosen: Iterable[str], limit: float, most: int = 1) -> tuple[int, list[str]]:
    """The exit code of the tests with a lie in place, which end at so many failures, and the tests that failed, or what
    was said last."""
    with copy.planted(lie):
        code, output = copy.run_command(lie, [*PYTEST, f"--maxfail={most}", *chosen], limit)
    lines = output.splitlines()
    failures = [line.removeprefix("FAILED ").split(" - ")[0] for line in lines if line.startswith("FAILED ")]
    return code, failures or lines[-1:] or [""]


def _by_the_lie(copy: Copy, lie: Mutation, test: str) -> bool:
    """Whether a test fails with the lie once more, and does not without: else chance found out what it did."""
    again, _ = _run(copy, lie, [test], LONGEST)
    truth, _ = copy.run_command(lie, [*PYTEST, test], LONGEST)
    return again != 0 and truth == 0


def _run_all(copy: Copy, lie: Mutation) -> tuple[int, str]:
    """The exit code of the whole suite and the first test that the lie makes fail."""
    by_chance: list[str] = []
    while True:
        others = [OF_THE_TABLE, *(f"--deselect={test}" for test in by_chance)]
        code, failed = _run(copy, lie, [*(f"tests/{room}" for room in ROOMS), *others], WHOLE, FEW)
        if code != 1:
            return code, failed[0]
        for test in failed:
            if _by_the_lie(copy, lie, test):
                return code, test
        by_chance += failed


def examine(copy: Copy, lie: Mutation, *, whole: bool = False) -> Outcome:
    """Plant a lie, and see who finds it out. Raises Stale."""
    began = monotonic()
    if whole:
        code, failed = _run_all(copy, lie)
    else:
        code, (failed, *_) = _run(copy, lie, lie.tests, LONGEST)
    tests = {0: SURVIVED, 1: CAUGHT, -1: CAUGHT}.get(code, BROKEN)
    product = ""
    if lie.product and not whole:
        solver, reason = lie.product
        with copy.planted(lie):
            _, said = copy.run_command(lie, ["-m", "tests.mutations.product", solver], LONGEST)
        product = CAUGHT if "failed:" in said and reason in said else SURVIVED
    return Outcome(lie.name, tests, product, round(monotonic() - began, 1), lie.digest, sources(), failed)
