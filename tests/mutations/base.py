"""What a planted lie is, and how it is planted."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


class Stale(Exception):
    """The sources have changed, and a fragment is not there exactly once; the message says which and what to do."""


@dataclass(frozen=True, slots=True)
class Mutation:
    """A lie: `fragment`, which stands in the file exactly once, becomes `replacement`.

    file: relative to the root; tests: as pytest takes them, of which at least one must fail; product: of a lie that a
    run must find out by itself, the solver to run and a word of the reason in its row.
    """

    name: str
    file: str
    fragment: str
    replacement: str
    tests: tuple[str, ...]
    product: tuple[str, str] | None = None

    def applied(self, root: Path) -> str:
        """The file's text with the lie in it. Raises Stale."""
        path = root / self.file
        if not path.is_file():
            raise Stale(f"{self.name}: there is no {self.file}; say in tests/mutations where it is now")
        text = path.read_text()
        found = text.count(self.fragment)
        if found != 1:
            raise Stale(
                f"{self.name}: {self.fragment!r} stands {found} times in {self.file}, and should stand there once; "
                "mend the fragment in tests/mutations"
            )
        return text.replace(self.fragment, self.replacement)

    @property
    def digest(self) -> str:
        """Of all that the table says of it."""
        return hashlib.sha256(repr(self).encode()).hexdigest()[:12]

    @property
    def compiled(self) -> bool:
        """Whether compiled code may hold what it changes, so that none from before will do."""
        return self.file.startswith("solvers/") or self.file == "harness/recording/strain_shading.py"
