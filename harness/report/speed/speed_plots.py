"""Plots of a speed report: each quantity against size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from springbench.harness.report.plot_style import STALE_NOTE
from springbench.harness.report.provenance_words import describe_machine_and_commit
from springbench.harness.report.speed.size_plot import CandidateLine, draw_size_plot
from springbench.harness.report.speed.speed_figures import STEP_ITERATIONS, SpeedFigures


@dataclass(frozen=True, slots=True)
class SpeedPlot:
    """One plot: file stem, title, and plotted value of a candidate.

    `is_share` states whether that is a share.
    """

    stem: str
    title: str
    get_value: Callable[[SpeedFigures], float | None]
    is_share: bool = False


SPEED_PLOTS = (
    SpeedPlot("step", f"Milliseconds a step of {STEP_ITERATIONS} iterations", lambda f: f.step),
    SpeedPlot("global", "Milliseconds a global step: one solve, three right-hand sides", lambda f: f.global_),
    SpeedPlot("local", "Milliseconds a local step", lambda f: f.local),
    SpeedPlot("prepare", "Milliseconds to prepare, warm", lambda f: f.warm or f.cold),
    SpeedPlot("limit", "Part of the limit that binds an iteration", lambda f: f.roofline_fraction, is_share=True),
)


def draw_speed_plots(candidates: Sequence[SpeedFigures], folder: Path) -> None:
    """Draw all plots of each scene as PNG files of PAGE_WIDTH x PAGE_HEIGHT pixels.

    Args:
        candidates: figures of all candidates.
        folder: folder that the files are written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cores = sorted({f.cores for f in candidates if f.cores})
    loads = [f.load_average for f in candidates if f.load_average is not None]
    facts = ["median over the rounds, candidates in turns", *(f"{count} cores" for count in cores)]
    facts += describe_machine_and_commit([{"cpu": f.cpu, "commit": f.commit} for f in candidates])
    if loads:
        facts.append(f"load {min(loads):.1f} to {max(loads):.1f}")
    facts += [STALE_NOTE] if any(f.is_stale for f in candidates) else []
    for scene in dict.fromkeys(f.scene for f in candidates):
        members = [f for f in candidates if f.scene == scene]
        for picture in SPEED_PLOTS:
            path = folder / f"{scene}-{picture.stem}.png"
            draw_size_plot(
                path, picture.title, [scene, *facts], _build_lines(members, picture), is_share=picture.is_share
            )


def _build_lines(members: Sequence[SpeedFigures], picture: SpeedPlot) -> list[CandidateLine]:
    """Build a line for each candidate of a scene."""
    lines: list[CandidateLine] = []
    for label in dict.fromkeys(f.label for f in members):
        mine = [f for f in members if f.label == label]
        points = sorted((f.vertices, value, f.is_stale) for f in mine if (value := picture.get_value(f)) is not None)
        alone = label.removesuffix(f" x{mine[0].threads}")
        n, values, older = (
            [point[0] for point in points],
            [point[1] for point in points],
            [point[2] for point in points],
        )
        lines.append(CandidateLine(label, alone, mine[0].solver, n, values, older))
    return lines
