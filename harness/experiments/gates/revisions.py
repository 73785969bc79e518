"""Git worktrees of revisions, with an own environment if the required libraries differ.

Worktrees stay in the user's cache, so that a revision is compiled once. Only the most recently used ones remain.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from harness.base.errors import InputError
from harness.base.files import open_lock, users_cache
from harness.experiments.gates.pair import Side

KEPT = 6
"""Maximum number of worktrees in the cache."""


def cache() -> Path:
    """Return the cache folder of worktrees."""
    return users_cache("revisions")


def root(folder: Path) -> Path:
    """Return the git checkout that contains a folder; raise InputError if there is none."""
    told = _git(folder, "rev-parse", "--show-toplevel")
    if told.returncode:
        raise InputError(f"--against: {folder} is in no git checkout ({_last(told.stderr)}); go to one")
    return Path(told.stdout.strip())


def resolve(checkout: Path, revision: str) -> str:
    """Return the commit that a revision names; raise InputError if it is unknown."""
    told = _git(checkout, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")
    if told.returncode:
        wanted = "wanted a commit, a branch or a tag, such as HEAD~1; `git log --oneline` lists them"
        raise InputError(f"--against: unknown revision {revision!r}; {wanted}")
    return told.stdout.strip()


def sides(checkout: Path, revision: str) -> tuple[Side, Side]:
    """Open the checkout with its uncommitted changes, and a revision; raise InputError on failure.

    Args:
        checkout: folder of the checkout.
        revision: commit, branch or tag.
    Returns: the checkout and the revision.
    """
    commit = resolve(checkout, revision)
    tree = worktree(checkout, commit)
    name = f"revision {revision}" if commit.startswith(revision) else f"revision {revision} ({commit[:10]})"
    return Side("this checkout", checkout), Side(name, tree, _python(checkout, tree, name), checkout)


def worktree(checkout: Path, commit: str) -> Path:
    """Return a clean worktree of a commit, from the cache or newly created.

    Raises:
        InputError: on failure.
    """
    tree = cache() / commit[:16]
    with _alone(cache()):
        _git(checkout, "worktree", "prune")
        if tree.exists():
            clean = _git(tree, "status", "--porcelain", "--untracked-files=no")
            if _git(tree, "rev-parse", "HEAD").stdout.strip() == commit and not clean.returncode and not clean.stdout:
                os.utime(tree)
                return tree
            shutil.rmtree(tree)
            _git(checkout, "worktree", "prune")
        told = _git(checkout, "worktree", "add", "--detach", "--force", str(tree), commit)
        if told.returncode:
            raise InputError(f"--against: no worktree of {commit[:10]}: {_last(told.stderr)}")
        for old in sorted(cache().glob("[0-9a-f]*"), key=lambda path: path.stat().st_mtime)[:-KEPT]:
            shutil.rmtree(old, ignore_errors=True)
    return tree


def _python(checkout: Path, tree: Path, name: str) -> Path:
    """Prepare the Python interpreter of a revision.

    It is this interpreter if the required libraries are equal, else that of the revision's own environment.
    """
    if _wanted(checkout) == _wanted(tree):
        return Path(sys.executable)
    own = tree / ".venv"
    python, whole = own / "bin" / "python", own / "whole"
    if whole.exists():  # what was killed on the way is built again
        return python
    shutil.rmtree(own, ignore_errors=True)
    for command in (
        [sys.executable, "-m", "venv", str(own)],
        [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-e", str(tree)],
    ):
        told = subprocess.run(command, cwd=tree, capture_output=True, text=True)
        if told.returncode:
            shutil.rmtree(own, ignore_errors=True)
            raise InputError(f"{name}: does not build: {_last(told.stderr or told.stdout)}")
    whole.touch()
    return python


def _wanted(tree: Path) -> Any:
    """Read the requirements of a worktree that determine its libraries."""
    try:
        project = tomllib.loads((tree / "pyproject.toml").read_text())["project"]
    except (OSError, KeyError, tomllib.TOMLDecodeError):
        return None
    return sorted(project.get("dependencies", ())), project.get("requires-python")


def _git(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True)
    except OSError as error:
        raise InputError(f"--against: git cannot be run ({error}); install it") from error


def _last(said: str) -> str:
    """Return the last line of a program's output."""
    return next((line.strip() for line in reversed(said.splitlines()) if line.strip()), "it does not say why")


@contextmanager
def _alone(folder: Path) -> Generator[None]:
    """Lock the cache so that one process at a time creates worktrees."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = open_lock(folder / ".lock")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)
