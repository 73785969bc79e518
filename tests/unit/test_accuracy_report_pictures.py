"""The accuracy report as files: pictures in two formats, findings and a summary."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv, to_rgb
from matplotlib.figure import Figure
from PIL import Image
from springbench.harness.recording.viewer_blueprint import BACKGROUND
from springbench.harness.report import page_layout
from springbench.harness.report.accuracy import draw_accuracy_report, plot_sheet
from springbench.harness.report.accuracy.accuracy_reader import read_accuracy
from springbench.harness.report.accuracy.convergence_plot import draw_convergence
from springbench.harness.report.accuracy.performance_profiles import draw_profiles
from springbench.harness.report.accuracy.size_scaling import draw_scalings
from springbench.harness.report.accuracy.time_to_accuracy_plot import draw_times_to_accuracy
from springbench.harness.report.accuracy.work_precision_plot import draw_work_precision
from springbench.harness.report.plot_style import (
    BACKGROUND_COLOUR,
    PAGE_HEIGHT,
    PAGE_WIDTH,
    STALE_NOTE,
    assign_solver_styles,
)
from springbench.harness.report.site.plotly_styles import plotly_style
from springbench.solvers.registry import SOLVER_TABLE, find_solver_info, load_target

from tests import synthetic_accuracy_rows as made


def small() -> list[dict]:
    """Two sizes of a scene, two solvers that converge, one in another minimum, failures, a doubt, simulations."""
    rows = []
    for size in (6, 12, 24):
        rows += made.build_snapshot_rows("net", size, "early", minima_count=2)
        for guess in ("previous", "inertial"):
            rows += made.build_curve_rows("net", size, "early", "numba", initial_guess=guess)
            rows += made.build_curve_rows(
                "net", size, "early", "newton", initial_guess=guess, minimum_index=int(size == 12)
            )
    rows += made.build_snapshot_rows("net", 6, "peak", certified=False)
    rows += made.build_curve_rows("net", 6, "peak", "lbfgs", status="time-limit", reason="the limit of 5 s was reached")
    rows.append(made.build_failure_row("net", 6, "peak", "dense", "unsupported", "knows springs </script> alone"))
    return rows + list(made.build_work_rows("net", 6))


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], dict[str, Figure]]:
    """The files of a report, and its pages by the names of their pictures."""
    folder, pages = made.write_accuracy_rows(tmp_path_factory.mktemp("mini"), small()), {}

    def save(sheet: Figure, path: Path) -> None:
        pages[f"{path.parent.name}/{path.stem}"] = sheet
        page_layout.save_page(sheet, path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot_sheet, "save_page", save)
        return draw_accuracy_report(folder), pages


def written(drawn: Figure) -> str:
    legends = [text for legend in drawn.legends for text in legend.get_texts()]
    inside = [text for ax in drawn.axes for text in ax.texts]
    return "\n".join(text.get_text() for text in (*drawn.texts, *inside, *legends))


def test_every_picture_is_there_in_both_formats_and_nothing_half_written(drawn) -> None:
    files, _ = drawn
    pictures = [path for path in files if path.suffix == ".png"]
    assert len(pictures) == 4 + 3 + 1 + 1 + 1, "steps, meshes with certified steps, simulations, profiles, growth"
    assert [path.with_suffix(".svg") for path in pictures] == [path for path in files if path.suffix == ".svg"]
    assert not list(files[0].parents[1].rglob(".*")), "no partial file is left"
    for path in pictures:
        with Image.open(path) as image:
            assert image.size == (PAGE_WIDTH, PAGE_HEIGHT)
            assert np.asarray(image.convert("L")).std() > 3, "an empty page has no variance"
        assert "<svg" in path.with_suffix(".svg").read_text()[:1000]


def test_the_same_rows_give_the_same_vectors(tmp_path: Path) -> None:
    rows = [*made.build_snapshot_rows("net", 6, "early"), *made.build_curve_rows("net", 6, "early", "numba")]
    table = read_accuracy(made.write_accuracy_rows(tmp_path, rows))
    once, again = (draw_times_to_accuracy(table, tmp_path / name)[1].read_text() for name in ("once", "again"))
    assert once == again


def test_doubtful_references_and_failures_are_marked_on_the_picture(drawn) -> None:
    pages = drawn[1]
    (doubtful,) = (page for name, page in pages.items() if "peak" in name)
    said = written(doubtful)
    assert "reference not certified" in said
    assert "× ended early (time-limit): lbfgs" in said
    assert "unsupported" in said
    crosses = [line for ax in doubtful.axes for line in ax.lines if line.get_marker() == "x"]
    assert {line.get_color() for line in crosses} == {assign_solver_styles([])["lbfgs"].color}
    (sure,) = (page for name, page in pages.items() if "net-24-early" in name)
    assert "not certified" not in written(sure)


def test_another_minimum_is_labelled_with_its_branch(drawn) -> None:
    (other,) = (page for name, page in drawn[1].items() if "net-12-early" in name)
    assert "in minimum 1, higher than the lowest known; vertex errors refer to it: newton" in written(other)
    assert sum(text.get_text() == "minimum 1" for ax in other.axes for text in ax.texts) == 4, "in each panel of gaps"


def test_the_default_of_the_assignment_and_methods_that_do_not_minimise_are_marked(drawn) -> None:
    said = written(drawn[1]["work/net-6"])
    assert said.count("the default") == 1
    assert "xpbd †" in said
    assert "numba †" not in said


def test_growth_is_labelled_at_the_ends_of_lines(drawn) -> None:
    assert "numba  $n^{1.00}$" in written(drawn[1]["report/growth"])


def test_what_other_code_measured_is_hollow_in_every_picture_and_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows: list[dict] = []
    for size in (6, 12, 24):
        rows += made.build_snapshot_rows("net", size, "early")
        for solver in ("numba", "newton"):
            rows += made.build_curve_rows(
                "net", size, "early", solver, source_fingerprint="before" if solver == "newton" else None
            )
    rows += [
        row | {"source_fingerprint": "before" if row["solver"] == "hybrid" else None}
        for row in made.build_work_rows("net", 6)
    ]
    pages: dict[str, Figure] = {}
    monkeypatch.setattr(plot_sheet, "save_page", lambda drawn, path: pages.setdefault(path.parent.name, drawn))
    table = read_accuracy(made.write_accuracy_rows(tmp_path, rows))
    for draw_all, name in (
        (draw_convergence, "convergence"),
        (draw_times_to_accuracy, "times"),
        (draw_work_precision, "work"),
    ):
        draw_all(table, tmp_path / name)
    for draw_one, name in ((draw_scalings, "growth"), (draw_profiles, "profiles")):
        draw_one(table, tmp_path / name / name)
    values = {"profiles": "Measured by other code than today's, in whole or in part: newton."}
    for name, solver in {"convergence": "newton", "times": "newton", "work": "hybrid", "growth": "newton"}.items():
        lines = [one for ax in pages[name].axes for one in ax.lines if len(np.asarray(one.get_xdata())) > 1]
        hollow = {
            one.get_color()
            for one in lines
            if one.get_marker() != "None" and one.get_markerfacecolor() == BACKGROUND_COLOUR
        }
        assert hollow == {assign_solver_styles([])[solver].color}, name
        values[name] = STALE_NOTE
    for name, words in values.items():
        assert words in written(pages[name]), name


# Machado, Oliveira and Fernandes 2009, "A Physiologically-based Model for Simulation of Color Vision Deficiency",
# severity 1: what people without one kind of cone see of linear RGB.
BLINDNESS = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "full sight": np.eye(3).tolist(),
}


def lab(color: str, matrix: list[list[float]] = BLINDNESS["full sight"]) -> np.ndarray:
    """Return CIELAB of a color as somebody sees it, but for its linear part near black."""
    rgb = np.array(to_rgb(color))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ np.clip(
        np.array(matrix) @ linear, 0, 1
    )
    x, y, z = np.cbrt(xyz / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("matrix", BLINDNESS.values(), ids=[*BLINDNESS])
def test_solvers_differ_in_colour_or_line_to_the_colour_blind_too(matrix: list[list[float]]) -> None:
    for (a, one), (b, other) in combinations(assign_solver_styles([]).items(), 2):
        apart = float(np.linalg.norm(lab(one.color, matrix) - lab(other.color, matrix)))
        # 10 is five times a just noticeable difference of CIELAB.
        assert apart > 10 or one.dash != other.dash, f"{a} and {b}: {apart:.1f}"


def test_families_are_far_apart_and_members_of_one_differ_in_lightness_line_and_marker() -> None:
    """Also in what the page makes of the styles."""
    looks = assign_solver_styles([])
    family = {name: find_solver_info(load_target(SOLVER_TABLE[name]), name).family for name in looks}
    for (a, one), (b, other) in combinations(looks.items(), 2):
        apart = float(np.linalg.norm(lab(one.color) - lab(other.color)))
        if family[a] != family[b]:
            assert apart >= 25.0, f"{a} and {b}: {apart:.1f}"
            continue
        assert apart >= 7.5, f"{a} and {b}: {apart:.1f}"
        assert one.dash != other.dash
        assert one.marker != other.marker
        shown, neighbour = plotly_style(one), plotly_style(other)
        assert shown["dash"] != neighbour["dash"]
        assert shown["symbol"] != neighbour["symbol"]


def luminance(color: Sequence[float]) -> float:
    rgb = np.array(color)
    return float(np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("name", [*SOLVER_TABLE, *(f"a stranger {k}" for k in range(12))])
def test_one_look_is_seen_on_the_light_page_and_on_the_dark_ground_of_the_viewer(name: str) -> None:
    color = luminance(to_rgb(assign_solver_styles([name])[name].color))
    page, ground = luminance(to_rgb(BACKGROUND_COLOUR)), luminance([part / 255 for part in BACKGROUND])
    # Contrast as the W3C defines it; 1.5 is that of a hairline, and lines are thick.
    assert (page + 0.05) / (color + 0.05) > 1.5
    assert (color + 0.05) / (ground + 0.05) > 1.5


def test_every_solver_has_a_look_and_a_marker_of_its_own() -> None:
    looks = assign_solver_styles([])
    assert set(looks) == set(SOLVER_TABLE)
    assert len({look.marker for look in looks.values()}) == len(looks)


def test_solvers_of_a_family_have_one_hue() -> None:
    hues: dict[str, set[int]] = {}
    for name, look in assign_solver_styles([]).items():
        hue, saturation, _ = rgb_to_hsv(to_rgb(look.color))
        hues.setdefault(find_solver_info(load_target(SOLVER_TABLE[name]), name).family, set()).add(
            round(360 * hue) if saturation > 0.1 else -1
        )
    # Two hexadecimal digits round a hue by a degree or two.
    assert all(max(found) - min(found) <= 3 for found in hues.values())
