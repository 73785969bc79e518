"""Memory of a process and all its descendants, from Linux's /proc."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress


class ProcessTreeMemory:
    """Monitor of the additional memory of all descendants of a process.

    Args:
        root: id of the process.
        gib: limit of the additional memory of all descendants [GiB].
    """

    def __init__(self, root: int, gib: float) -> None:
        self._root, self._most = root, gib * 2**30
        self._before = {
            process: _read_proc_bytes(process, "status", ("VmData:",)) for process in _iterate_descendants(root)
        }

    @property
    def is_exceeded(self) -> bool:
        """Whether new processes, and the growth of earlier ones, exceed the limit.

        False without new processes, because the earlier ones have limits of their own.
        """
        new = set(found := list(_iterate_descendants(self._root))) - self._before.keys()
        if not new:
            return False
        taken = sum(_read_proc_bytes(process, "smaps_rollup", ("Private_Dirty:", "Pss_Shmem:")) for process in new)
        others = [process for process in self._before if process in found]
        return (
            taken + sum(_read_proc_bytes(one, "status", ("VmData:",)) - self._before[one] for one in others)
            > self._most
        )


def _iterate_descendants(process: int) -> Iterator[int]:
    with suppress(OSError):
        for thread in os.listdir(f"/proc/{process}/task"):
            with suppress(OSError), open(f"/proc/{process}/task/{thread}/children") as file:
                for child in map(int, file.read().split()):
                    yield child
                    yield from _iterate_descendants(child)


def _read_proc_bytes(process: int, file: str, names: tuple[str, ...]) -> int:
    """Sum the lines `name: ... kB` of a /proc file [bytes]; 0 if the process has ended."""
    with suppress(OSError), open(f"/proc/{process}/{file}") as lines:
        return sum(1024 * int(line.split()[1]) for line in lines if line.startswith(names))
    return 0
