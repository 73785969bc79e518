"""Git worktrees of revisions, with separate environments if the required libraries differ.

Worktrees stay in the user's cache, so that a revision is compiled once. Only the most recently used ones remain.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from springbench.harness.atomic_files import get_user_cache_dir, open_lock_file
from springbench.harness.errors import InputError
from springbench.harness.experiments.regression.revision_process import PACKAGE_FOLDER, GitRevision
from springbench.solvers.platform_calls import LockMode, wait_for_lock

MAX_WORKTREES = 6
"""Maximum number of worktrees in the cache."""


def locate_worktree_cache() -> Path:
    """Return the cache folder of worktrees."""
    return get_user_cache_dir("revisions")


def find_checkout(folder: Path) -> Path:
    """Return the git checkout that contains a folder; raise InputError if there is none."""
    done = _run_git(folder, "rev-parse", "--show-toplevel")
    if done.returncode:
        raise InputError(f"--baseline: {folder} is in no git checkout ({_last_line(done.stderr)}); change to one")
    return Path(done.stdout.strip())


def resolve_commit(checkout: Path, revision: str) -> str:
    """Return the full hash of the commit that a revision names.

    Args:
        checkout: folder of the git checkout.
        revision: commit, branch or tag.

    Raises:
        InputError: the revision is unknown.
    """
    done = _run_git(checkout, "rev-parse", "--verify", "--quiet", "--end-of-options", f"{revision}^{{commit}}")
    if done.returncode:
        expected = "expected a commit, a branch or a tag, such as HEAD~1; `git log --oneline` lists them"
        raise InputError(f"--baseline: unknown revision {revision!r}; {expected}")
    return done.stdout.strip()


def open_revisions(checkout: Path, revision: str) -> tuple[GitRevision, GitRevision]:
    """Open the checkout with its uncommitted changes, and a revision.

    Args:
        checkout: folder of the checkout.
        revision: commit, branch or tag.

    Returns:
        The checkout and the revision.

    Raises:
        InputError: the revision is unknown, too old, or cannot be installed.
    """
    commit = resolve_commit(checkout, revision)
    tree = prepare_worktree(checkout, commit)
    name = f"revision {revision}" if commit.startswith(revision) else f"revision {revision} ({commit[:10]})"
    if (checkout / PACKAGE_FOLDER).is_dir() and not (tree / PACKAGE_FOLDER).is_dir():
        raise InputError(
            f"--baseline: {name} has no folder {PACKAGE_FOLDER}, so its code cannot be run by this checkout; "
            "choose a later revision"
        )
    return GitRevision("this checkout", checkout), GitRevision(
        name, tree, _prepare_python(checkout, tree, name), checkout
    )


def prepare_worktree(checkout: Path, commit: str) -> Path:
    """Return a clean worktree of a commit, from the cache or newly created.

    Args:
        checkout: git checkout that contains the commit.
        commit: full hash of the commit.

    Raises:
        InputError: git cannot create the worktree.
    """
    tree = locate_worktree_cache() / commit[:16]
    with _lock_exclusive(locate_worktree_cache()):
        _run_git(checkout, "worktree", "prune")
        if tree.exists():
            clean = _run_git(tree, "status", "--porcelain", "--untracked-files=no")
            if (
                _run_git(tree, "rev-parse", "HEAD").stdout.strip() == commit
                and not clean.returncode
                and not clean.stdout
            ):
                os.utime(tree)  # marks it as used most recently
                return tree
            shutil.rmtree(tree)
            _run_git(checkout, "worktree", "prune")
        done = _run_git(checkout, "worktree", "add", "--detach", "--force", str(tree), commit)
        if done.returncode:
            raise InputError(f"--baseline: no worktree of {commit[:10]}: {_last_line(done.stderr)}")
        for old in sorted(locate_worktree_cache().glob("[0-9a-f]*"), key=lambda path: path.stat().st_mtime)[
            :-MAX_WORKTREES
        ]:
            shutil.rmtree(old, ignore_errors=True)
    return tree


def _prepare_python(checkout: Path, tree: Path, name: str) -> Path:
    """Prepare the Python interpreter of a revision.

    It is this interpreter if the required libraries are equal, else that of the revision's own environment.
    """
    if _read_requirements(checkout) == _read_requirements(tree):
        return Path(sys.executable)
    own = tree / ".venv"
    python, whole = own / "bin" / "python", own / "whole"
    if whole.exists():  # an interrupted build is repeated
        return python
    shutil.rmtree(own, ignore_errors=True)
    for command in (
        [sys.executable, "-m", "venv", str(own)],
        [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "-e", str(tree)],
    ):
        done = subprocess.run(command, cwd=tree, capture_output=True, text=True)
        if done.returncode:
            shutil.rmtree(own, ignore_errors=True)
            raise InputError(f"{name}: cannot be installed: {_last_line(done.stderr or done.stdout)}")
    whole.touch()
    return python


def _read_requirements(tree: Path) -> Any:
    """Read the requirements of a worktree that determine its libraries."""
    try:
        project = tomllib.loads((tree / "pyproject.toml").read_text())["project"]
    except (OSError, KeyError, tomllib.TOMLDecodeError):
        return None
    return sorted(project.get("dependencies", ())), project.get("requires-python")


def _run_git(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True)
    except OSError as error:
        raise InputError(f"--baseline: git cannot be run ({error}); install it") from error


def _last_line(output: str) -> str:
    """Return the last line of a program's output."""
    return next((line.strip() for line in reversed(output.splitlines()) if line.strip()), "no reason given")


@contextmanager
def _lock_exclusive(folder: Path) -> Generator[None]:
    """Lock the cache so that one process at a time creates worktrees."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = open_lock_file(folder / ".lock")
    try:
        wait_for_lock(lock, LockMode.EXCLUSIVE)
        yield
    finally:
        os.close(lock)
