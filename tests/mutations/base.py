"""What a planted error is, and how it is planted."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


class StaleMutation(Exception):
    """A fragment does not stand in today's sources exactly once; the message names it and says what to do."""


@dataclass(frozen=True, slots=True)
class Mutation:
    """A planted error: `fragment`, which stands in the file exactly once, becomes `replacement`.

    file: relative to the root; tests: as pytest takes them, of which at least one must fail; product: for an error that
    a run must detect by itself, the solver to run and a word of the reason in its row.
    """

    name: str
    file: str
    fragment: str
    replacement: str
    tests: tuple[str, ...]
    product: tuple[str, str] | None = None

    def apply(self, root: Path) -> str:
        """The file's text with the error in it. Raises StaleMutation."""
        path = root / self.file
        if not path.is_file():
            raise StaleMutation(f"{self.name}: there is no {self.file}; say in tests/mutations where it is now")
        text = path.read_text()
        found = text.count(self.fragment)
        if found != 1:
            raise StaleMutation(
                f"{self.name}: {self.fragment!r} stands {found} times in {self.file}, and should stand there once; "
                "mend the fragment in tests/mutations"
            )
        return text.replace(self.fragment, self.replacement)

    @property
    def digest(self) -> str:
        """Digest of this entry of the table."""
        return hashlib.sha256(repr(self).encode()).hexdigest()[:12]
