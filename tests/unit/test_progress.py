"""The time left is told once it is known, and never from what was compiled; something is printed while nothing ends."""

from __future__ import annotations

import io
from collections.abc import Callable

import pytest
from rich.console import Console

from harness.base import progress
from harness.base.asides import COMPILING, LOOK, aside
from harness.base.progress import Bars, Display, Lines


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What the clock shows, in its only entry."""
    now = [0.0]
    monkeypatch.setattr(progress, "monotonic", lambda: now[0])
    return now


def told(kind: Callable[[Console], Display], does: Callable[[Display], None]) -> str:
    out = io.StringIO()
    display = kind(Console(file=out, force_terminal=kind is Bars, width=200))
    does(display)
    display.end()
    return out.getvalue()


@pytest.mark.parametrize("kind", [Lines, Bars])
def test_the_time_left_follows_from_the_work_of_runs_that_have_ended(kind: Callable[..., Display], clock: list[float]):
    def does(display: Display) -> None:
        display.begin(4, 100.0)
        for work, seconds in ((10.0, 5.0), (40.0, 20.0)):  # 0.5 s for each of the work
            run = display.run("one", 10, work)
            with aside(run.tick, COMPILING):
                clock[0] += 300.0
            clock[0] += seconds
            run.finished("ok")

    lines = told(kind, does)
    assert lines.count("left") >= 1
    assert "about 25 s left" in lines
    assert "3" not in "".join(part.split("s left")[0][-5:] for part in lines.split("about ")[1:])  # nothing of 300 s
    first = lines.split("one: ok")[1]
    assert kind is Bars or "left" not in first  # a tenth of the work tells nothing yet


def test_a_line_comes_though_no_run_ends(clock: list[float]):
    def does(display: Display) -> None:
        display.begin(1, 10.0)
        run = display.run("one", 10, 10.0)
        run.tick("timed pass")
        for _ in range(35):
            clock[0] += 1.0
            run.tick(LOOK)

    lines = told(Lines, does).splitlines()
    assert lines == ["[0/1] one: timed pass, 10 %"] * 3


def test_what_is_compiled_is_told_while_it_is(clock: list[float]):
    def does(display: Display) -> None:
        display.begin(1, 10.0)
        run = display.run("one", 10, 10.0)
        with aside(run.tick, COMPILING):
            clock[0] += 11.0
            run.tick(LOOK)

    assert "one: compiling (once), 0 %" in told(Lines, does)
