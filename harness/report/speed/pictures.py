"""Plots of a speed report: each quantity against size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.report.origin import machine_and_commit
from harness.report.speed.figures import STEP, Figures
from harness.report.speed.size_plot import CandidateLine, draw_by_size
from harness.report.style import OLDER


@dataclass(frozen=True, slots=True)
class SpeedPicture:
    """One plot: file stem, title, and plotted value of a candidate.

    `share` states whether that is a share.
    """

    stem: str
    title: str
    value: Callable[[Figures], float | None]
    share: bool = False


PICTURES = (
    SpeedPicture("step", f"Milliseconds a step of {STEP} iterations", lambda f: f.step),
    SpeedPicture("global", "Milliseconds a global step: one solve, three right-hand sides", lambda f: f.global_),
    SpeedPicture("local", "Milliseconds a local step", lambda f: f.local),
    SpeedPicture("prepare", "Milliseconds to prepare, warm", lambda f: f.warm or f.cold),
    SpeedPicture("limit", "Part of the limit that binds an iteration", lambda f: f.reached, share=True),
)


def draw(found: Sequence[Figures], folder: Path) -> None:
    """Draw all plots of each scene as PNG files of WIDTH x HEIGHT pixels.

    Args:
        found: figures of all candidates.
        folder: folder that the files are written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cores = sorted({f.cores for f in found if f.cores})
    loads = [f.load for f in found if f.load is not None]
    facts = ["median over the rounds, candidates in turns", *(f"{count} cores" for count in cores)]
    facts += machine_and_commit([{"cpu": f.cpu, "commit": f.commit} for f in found])
    if loads:
        facts.append(f"load {min(loads):.1f} to {max(loads):.1f}")
    facts += [OLDER] if any(f.older for f in found) else []
    for scene in dict.fromkeys(f.scene for f in found):
        members = [f for f in found if f.scene == scene]
        for picture in PICTURES:
            path = folder / f"{scene}-{picture.stem}.png"
            draw_by_size(path, picture.title, [scene, *facts], _series(members, picture), share=picture.share)


def _series(members: Sequence[Figures], picture: SpeedPicture) -> list[CandidateLine]:
    """Build a line for each candidate of a scene."""
    lines: list[CandidateLine] = []
    for label in dict.fromkeys(f.label for f in members):
        mine = [f for f in members if f.label == label]
        points = sorted((f.vertices, value, f.older) for f in mine if (value := picture.value(f)) is not None)
        alone = label.removesuffix(f" x{mine[0].threads}")
        n, values, older = (
            [point[0] for point in points],
            [point[1] for point in points],
            [point[2] for point in points],
        )
        lines.append(CandidateLine(label, alone, mine[0].solver, n, values, older))
    return lines
