"""The timing plot and the summary table, from rows whose times are known."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.figure import Figure
from PIL import Image
from rich.console import Console

from harness.base.columns import SCHEMA
from harness.report import page, timing_plot
from harness.report.labels import LINE, spread
from harness.report.learned import closing, sentences
from harness.report.style import HEIGHT, WIDTH, marks
from harness.report.timing_plot import draw_timing
from harness.report.timing_table import APART, INTERRUPTED, labels, runs, summary_table
from solvers.registry import EVERY

ROOT = Path(__file__).parents[2]
POWERS = {"sparse": 1.0, "dense": 2.0, "xpbd": 1.5}  # of the vertices, in the times of each solver
EXPLOSION = "the positions are not finite from frame 3 on"


def rows(
    scenes: Sequence[str] = ("cloth",),
    sizes: Sequence[int] = (8, 16, 32),
    solvers: Sequence[str] = tuple(POWERS),
    *,
    failed: Sequence[tuple[int, str]] = (),
    omegas: Sequence[float] = (1.0,),
) -> pa.Table:
    """Rows of a sweep in which a step takes 1e-6 s times a power of the vertices; the quartiles are 0.5 % apart."""
    out: list[dict[str, Any]] = []
    for scene in scenes:
        for size in sizes:
            for solver in solvers:
                for omega in omegas:
                    out += run_rows(scene, size, solver, omega, failed=(size, solver) in failed)
    return pa.Table.from_pylist(out, schema=SCHEMA)


def run_rows(scene: str, size: int, solver: str, omega: float, *, failed: bool) -> list[dict[str, Any]]:
    known = {
        "run_id": f"{scene} {size} {solver} {omega}",
        "scene": scene,
        "size": size,
        "solver": solver,
        "parameters": json.dumps({"omega": omega}),
        "vertices": size**2,
        "springs": 4 * size**2,
        "time_step": 0.01,
        "max_iterations": 10,
        "threads": 1,
        "status": "ok",
    }
    if failed:
        return [{**known, "phase": "run", "status": "diverged", "reason": EXPLOSION}]
    second = 1e-6 * omega * (size**2) ** POWERS.get(solver, 1.0)
    prepare = [
        {**known, "phase": "prepare", "round": k, "seconds": seconds * second} for k, seconds in enumerate((8, 2, 4, 3))
    ]
    steps = [
        {
            **known,
            "phase": "step",
            "frame": k + 1,
            "round": 0,
            "seconds": second * (0.99 + 0.005 * k),
            "iterations": 10,
            "residual": 10.0**-k,
            "stopped": "tolerance" if k else "iterations",
            "largest_strain": 0.1 * k,
            "strain_99": 0.01 * k,
        }
        for k in range(5)
    ]
    phases = [
        {**known, "phase": phase, "round": 0, "seconds": share * second}
        for phase, share in (("local", 0.1), ("global", 0.2))
    ]
    return prepare + steps + phases


def learned(**how: Any) -> list[str]:
    """Whole sentences of what rows say."""
    return learned_from(rows(**how).to_pylist())


def learned_from(told: list[dict[str, Any]]) -> list[str]:
    lines = "\n".join(sentences(runs(pa.Table.from_pylist(told, schema=SCHEMA))))
    return lines.replace("\n  ", " ").splitlines()


@pytest.fixture
def sheets(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The pages that a test draws."""
    drawn: list[Figure] = []

    def save(sheet: Figure, path: Path, **more: Any) -> None:
        drawn.append(sheet)
        page.save(sheet, path, **more)

    monkeypatch.setattr(timing_plot, "save", save)
    return drawn


def written(sheet: Figure) -> list[str]:
    return [text.get_text() for text in [*sheet.texts, *(t for ax in sheet.axes for t in ax.texts)]]


def test_a_run_is_summed_up_in_milliseconds() -> None:
    (run,) = runs(rows(sizes=(10,), solvers=("sparse",)))
    # The step takes 1e-6 s * 100 = 0.1 ms; round-off of a few products.
    expected = {"cold": 0.8, "warm": 0.3, "step": 0.1, "least": 0.099, "lower": 0.0995, "upper": 0.1005}
    expected |= {
        "local": 0.01,
        "global_": 0.02,
        "iterations": 10,
        "residual": 1e-4,
        "largest_strain": 0.4,
        "strain_99": 0.04,
    }
    assert {name: getattr(run, name) for name in expected} == pytest.approx(expected, rel=1e-9)
    assert (run.scene, run.size, run.vertices, run.springs, run.status) == ("cloth", 10, 100, 400, "ok")
    assert run.stopped == "iterations", "one step of five was cut off"


def test_runs_keep_the_order_of_their_rows() -> None:
    table = rows(scenes=("net", "cloth"), sizes=(16, 8))
    order = list(dict.fromkeys(table["run_id"].to_pylist()))
    assert [run.run_id for run in runs(table)] == order


def test_labels_name_only_the_settings_in_which_a_solvers_runs_differ() -> None:
    same, varied = (runs(rows(solvers=("sparse",), omegas=omegas)) for omegas in ((1.0,), (1.0, 1.5)))
    assert set(labels(same).values()) == {"sparse"}
    assert set(labels(varied).values()) == {"sparse, omega 1.0", "sparse, omega 1.5"}


@pytest.mark.parametrize(
    "table",
    [
        pytest.param(rows(), id="three solvers"),
        pytest.param(rows(sizes=(8,), solvers=("sparse",)), id="one run"),
        pytest.param(rows(scenes=("a-scene-with-a-long-name-" * 4, "b", "c", "d", "e")), id="five scenes"),
        pytest.param(rows(sizes=(2,), solvers=("dense",), failed=[(2, "dense")]), id="nothing succeeded"),
        pytest.param(SCHEMA.empty_table(), id="no rows"),
    ],
)
def test_every_table_gives_a_plot_of_the_page_s_width(table: pa.Table, tmp_path: Path) -> None:
    draw_timing(table, tmp_path / "time.png", "A title that is too long for the page " * 5)
    with Image.open(tmp_path / "time.png") as image:
        assert image.width == WIDTH
        assert 200 < image.height <= HEIGHT
        assert np.asarray(image.convert("L")).std() > 3, "an empty page has no variance"
    assert [file.name for file in tmp_path.iterdir()] == ["time.png"], "no partial file is left"


def test_each_solver_is_a_line_named_with_its_fitted_power(sheets: list[Figure], tmp_path: Path) -> None:
    draw_timing(rows(), tmp_path / "time.png", "Scaling")
    said = written(sheets[0])
    for solver, power in POWERS.items():
        assert f"{solver}  $n^{{{power:.1f}}}$" in said
    step = sheets[0].axes[0]
    heights = {tuple(np.round(np.asarray(line.get_ydata(), float), 6)) for line in step.lines}
    assert (0.064, 0.256, 1.024) in heights, "the medians of sparse, in milliseconds"


def test_failed_runs_are_crosses_at_the_upper_edge_and_words(sheets: list[Figure], tmp_path: Path) -> None:
    draw_timing(rows(failed=[(16, "dense"), (32, "dense")]), tmp_path / "time.png", "Scaling")
    step = sheets[0].axes[0]
    crosses = [line for line in step.lines if line.get_marker() == "x"]
    assert [list(map(float, np.asarray(line.get_xdata()))) for line in crosses] == [[256.0], [1024.0]]
    assert all(float(np.asarray(line.get_ydata())[0]) > 0.9 for line in crosses), "in shares of the panel's height"
    assert {line.get_color() for line in crosses} == {marks(POWERS)["dense"].color}
    said = written(sheets[0])
    assert said.count("diverged") == 2
    assert f"dense on cloth, size 32 diverged: {EXPLOSION}" in said


def test_preparing_has_its_own_panel_cold_and_warm(sheets: list[Figure], tmp_path: Path) -> None:
    draw_timing(rows(solvers=("sparse",)), tmp_path / "time.png", "Scaling")
    cold, warm = (np.asarray(line.get_ydata(), float) for line in sheets[0].axes[1].lines)
    assert cold == pytest.approx(8 / 3 * warm)


@pytest.mark.parametrize("wanted", [[10.0, 11.0, 12.0], [10.0, 60.0, 99.0], [90.0, 95.0, 99.0]])
def test_direct_labels_do_not_overlap_and_stay_on_the_panel(wanted: list[float]) -> None:
    at = spread(wanted, 6.0, 100.0)
    assert (np.diff(at) >= LINE).all()
    assert min(at) >= 6.0
    assert max(at) <= 100.0


def test_solvers_have_marks_of_their_own_that_stay_the_same() -> None:
    names = [f"method-{k:02}" for k in range(20)]
    assert len(set(marks(names).values())) == 20 + len(EVERY), "colour and marker together tell solvers apart"
    for solver in EVERY:
        assert marks([])[solver] == marks(names)[solver]
    assert marks(names) == marks(reversed(names))


def test_the_summary_has_a_line_for_each_run() -> None:
    console = Console(width=200, record=True, file=StringIO())
    console.print(summary_table(rows(sizes=(10,), failed=[(10, "dense")])))
    lines = [" ".join(line.split()) for line in console.export_text().splitlines()]
    assert "cloth: times in milliseconds, medians over the rounds and over the steps" in lines
    assert "10 sparse 0.8 0.3 0.1 0.099 0.01 0.02 10 iterations 1.0e-04 40 % 4 %" in lines
    assert f"10 dense{7 * ' –'} diverged{3 * ' –'}" in lines


def test_the_summary_and_the_words_after_it_fit_a_hundred_columns() -> None:
    scenes, sizes = ("hanging-cloth", "a-scene-with-a-long-name"), (8, 32)
    table = rows(scenes=scenes, sizes=sizes, solvers=("local-global-sparse", "dense"), omegas=(1.0, 1.25))
    console = Console(width=240, record=True, file=StringIO())
    console.print(summary_table(table))
    assert max(len(line.rstrip()) for line in console.export_text().splitlines()) <= 100
    assert max(map(len, sentences(runs(table)))) <= 98, "two more go before each"


def test_what_was_learned_is_told_and_what_is_not_so_is_not() -> None:
    (speed, limit) = learned(sizes=(10, 20), failed=[(20, "dense")])
    assert "cloth 10, equal residuals, 1.0e-04: a step by sparse is shortest; xpbd 10 times, dense 100" in speed
    assert limit.startswith("All 5 runs stopped at the limit of iterations")
    told = rows(sizes=(10, 20), solvers=("sparse", "dense")).to_pylist()
    for row in told:
        row["stopped"] = row["stopped"] and "tolerance"
        row["residual"] = row["residual"] and row["residual"] * (100 if row["solver"] == "dense" else 1)
        row["largest_strain"] = row["largest_strain"] and row["largest_strain"] * row["size"]
    (speed, strain) = learned_from(told)
    assert "cloth 20, unequal residuals, 1.0e-04 to 1.0e-02" in speed
    assert "grows with the mesh, from 400 to 800 %, where 99 % of the springs stay below 4 and 4 %" in strain


def test_a_sweep_ends_with_three_commands_and_one_link(tmp_path: Path) -> None:
    table, config = rows(scenes=("hanging-cloth",)), ROOT / "configs" / "quickstart.yaml"
    results = tmp_path / "my results"
    (results / "q" / "recordings").mkdir(parents=True)
    seen = results / "q" / "recordings" / "hanging-cloth-32-sparse-hanging-cloth 32 sparse 1.0.rrd"
    seen.touch()
    lines = closing(table, config, results, results / "q")
    commands = [shlex.split(line) for line in lines if line.startswith("  springbench")]
    scene = str(ROOT / "configs" / "scenes" / "hanging-cloth.yaml")
    assert commands == [
        ["springbench", "view", str(seen)],
        ["springbench", "recommend", "--error", "1e-2", scene],
        ["springbench", "report", str(results)],
    ]
    (results / "index.html").touch()
    assert closing(table, config, results, results / "q")[-1].endswith("/my%20results/index.html")


def test_the_summary_marks_times_that_are_doubtful_and_says_why() -> None:
    told = rows(sizes=(10,), solvers=("sparse",)).to_pylist()
    for row in told:
        row["interrupted"] = row["phase"] == "step" and row["frame"] == 2
        row["adds_up"] = False if row["phase"] in ("local", "global") else None
    console = Console(width=200, record=True, file=StringIO())
    console.print(summary_table(pa.Table.from_pylist(told, schema=SCHEMA)))
    text = " ".join(console.export_text().split())
    assert "10 sparse 0.8 0.3 0.1! 0.099 0.01~ 0.02~ 10" in text
    assert INTERRUPTED in text
    assert APART in text
    console.print(summary_table(rows(sizes=(10,), solvers=("sparse",))))
    text = " ".join(console.export_text().split())
    assert not {"!", "~"} & set(text.split("below")[-1]), "rows that say nothing of it have no marks"
