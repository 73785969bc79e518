"""Which panels names lead to, and what mistakes are answered with: exit code 2, what was expected, and no file."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.cli.main import app
from springbench.harness.report.charts.figure_panels import AxisScale, CurvePlot
from springbench.harness.report.figures.panel_selection import entries_from_panels, select_entries
from typer.testing import CliRunner

from tests import synthetic_results as made


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a sweep."""
    return made.write_sweep_results(tmp_path_factory.mktemp("sweep"))


BAD = {
    "unknown kind": (["timin"], "KIND: got 'timin'; expected one of", "did you mean 'timing'?"),
    "a width without a unit": (["timing", "--width", "85"], "--width: got '85'; expected a length such as 85mm", ""),
    "a width of no figure": (["timing", "--width", "3mm"], "--width: got 3mm; expected from 40mm to 400mm", ""),
    "an unknown format": (["timing", "--format", "pdf,gif"], "--format: got 'gif'; expected one of pdf, png, svg", ""),
    "no format": (["timing", "--format", ","], "--format: got ''; expected one of pdf, png, svg", ""),
    "small type": (["timing", "--font-size", "5"], "--font-size: got 5; expected from 6 to 24 points", ""),
    "no such panel": (
        ["timing", "--panels", "gap:tine"],
        "--panels: got 'gap:tine'; expected parts of",
        "geometry-flat:step",
    ),
    "curves and a map": (
        ["hard", "--panels", "shares,map:geometry"],
        "--panels: got shares:right, map:geometry, of which some are curves and some are maps",
        "draw the others as a figure of their own",
    ),
    "nothing of that kind": (["convergence"], "contains no accuracy rows; run `springbench accuracy CONFIG`", ""),
    "no ablation": (["ablation"], "expected the rows of `springbench ablate SCENE`", ""),
    "no speed": (["speed"], "expected the rows of `springbench roofline CONFIG`", ""),
    "no recordings": (["run"], "contains no recordings; run a sweep with `record: true`", ""),
    "type that does not fit": (["timing", "--width", "40mm", "--font-size", "20"], "expected a wider figure", "is cut"),
    "a report without panels": (["medians"], "KIND: got 'medians'; expected one of", ""),
}


@pytest.mark.parametrize("name", BAD)
def test_a_mistake_is_reported_with_the_expected_input(results: Path, name: str, tmp_path: Path) -> None:
    (kind, *more), *expected = BAD[name]
    result = CliRunner().invoke(app, ["figure", kind, str(results), *more, "-o", str(tmp_path)])
    assert result.exit_code == 2, result.output
    assert all(words in result.output for words in expected), result.output
    assert not list(tmp_path.iterdir())


def test_panels_are_named_by_parts() -> None:
    def plot(*parts: str) -> CurvePlot:
        return CurvePlot(parts[:1], parts[1:], "", "", AxisScale(""), AxisScale(""), [])

    entries = entries_from_panels(
        [plot(a, b, c) for a in ("net", "block") for b in ("gap", "largest") for c in ("time", "iterations")]
    )

    def select_names(*selectors: str) -> list[str]:
        return [
            ":".join(one.name_parts) for one in select_entries(entries, [tuple(one.split(":")) for one in selectors])
        ]

    assert select_names("gap:time") == ["net:gap:time"], "of the first, where it is not said of what"
    assert select_names("block:gap:time", "net:time") == ["block:gap:time", "net:gap:time", "net:largest:time"]
    assert select_names("net:gap", "gap:net") == ["net:gap:time", "net:gap:iterations"]
