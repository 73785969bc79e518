"""The timing plot and the summary table, from rows whose times are known."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from PIL import Image
from rich.console import Console
from springbench.harness.report import timing_plot
from springbench.harness.report.charts.timing_chart import build_timing_chart
from springbench.harness.report.plot_style import PAGE_WIDTH, assign_solver_styles
from springbench.harness.report.sweep_pictures import PictureJob, draw_sweep_pictures
from springbench.harness.report.sweep_summary import build_closing_lines, summarise_sweep
from springbench.harness.report.timing_plot import draw_timing_plot
from springbench.harness.report.timing_table import (
    INCONSISTENT_NOTE,
    PREEMPTED_NOTE,
    build_summary_table,
    label_runs,
    read_run_times,
)
from springbench.harness.results.run_schema import RUN_SCHEMA
from springbench.harness.scenes.mesh.mesh import STRETCH
from springbench.harness.scenes.mesh.mesh_table import MESH_CLASSES
from springbench.harness.scenes.spring_stiffness import (
    SCALING_RULES,
    compute_modulus_exponent,
    compute_spring_stiffness,
)
from springbench.solvers.registry import SOLVER_TABLE, load_target

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
    return pa.Table.from_pylist(out, schema=RUN_SCHEMA)


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
            "num_iterations": 10,
            "residual": 10.0**-k,
            "termination_reason": "converged" if k else "max-iter",
            "max_strain": 0.1 * k,
            "strain_p99": 0.01 * k,
        }
        for k in range(5)
    ]
    phases = [
        {**known, "phase": phase, "round": 0, "seconds": share * second}
        for phase, share in (("local", 0.1), ("global", 0.2))
    ]
    return prepare + steps + phases


def summarise_rows(**how: Any) -> list[str]:
    """Whole sentences of what rows say."""
    return learned_from(rows(**how).to_pylist())


def learned_from(message: list[dict[str, Any]]) -> list[str]:
    lines = "\n".join(summarise_sweep(read_run_times(pa.Table.from_pylist(message, schema=RUN_SCHEMA))))
    return lines.replace("\n  ", " ").splitlines()


def test_a_run_is_summed_up_in_milliseconds() -> None:
    (run,) = read_run_times(rows(sizes=(10,), solvers=("sparse",)))
    # The step takes 1e-6 s * 100 = 0.1 ms; round-off of a few products.
    expected = {"cold": 0.8, "warm": 0.3, "step": 0.1, "least": 0.099, "lower": 0.0995, "upper": 0.1005}
    expected |= {
        "local": 0.01,
        "global_": 0.02,
        "num_iterations": 10,
        "residual": 1e-4,
        "max_strain": 0.4,
        "strain_p99": 0.04,
    }
    assert {name: getattr(run, name) for name in expected} == pytest.approx(expected, rel=1e-9)
    assert (run.scene, run.size, run.vertices, run.springs, run.status) == ("cloth", 10, 100, 400, "ok")
    assert run.termination_reason == "max-iter", "one step of five was cut off"


def test_runs_have_the_order_of_their_rows() -> None:
    table = rows(scenes=("net", "cloth"), sizes=(16, 8))
    order = list(dict.fromkeys(table["run_id"].to_pylist()))
    assert [run.run_id for run in read_run_times(table)] == order


def test_labels_name_only_the_settings_in_which_a_solvers_runs_differ() -> None:
    same, varied = (read_run_times(rows(solvers=("sparse",), omegas=omegas)) for omegas in ((1.0,), (1.0, 1.5)))
    assert set(label_runs(same).values()) == {"sparse"}
    assert set(label_runs(varied).values()) == {"sparse, omega 1.0", "sparse, omega 1.5"}


@pytest.mark.parametrize(
    "table",
    [
        pytest.param(rows(), id="three solvers"),
        pytest.param(rows(sizes=(8,), solvers=("sparse",)), id="one run"),
        pytest.param(rows(scenes=("a-scene-with-a-long-name-" * 4, "b", "c", "d", "e")), id="five scenes"),
    ],
)
def test_every_table_gives_a_plot_of_the_page_s_width(table: pa.Table, tmp_path: Path) -> None:
    paths = draw_timing_plot(table, tmp_path / "time.png", "A title that is too long for the page " * 5)
    with Image.open(tmp_path / "time.png") as image:
        assert image.width == PAGE_WIDTH
        assert np.asarray(image.convert("L")).std() > 3, "an empty page has no variance"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["time.png", "time.svg"], "no partial file is left"
    assert sorted(paths) == sorted(tmp_path.iterdir())


@pytest.mark.parametrize(
    "table",
    [
        pytest.param(rows(sizes=(2,), solvers=("dense",), failed=[(2, "dense")]), id="nothing succeeded"),
        pytest.param(RUN_SCHEMA.empty_table(), id="no rows"),
    ],
)
def test_without_a_time_there_is_no_plot_and_an_old_one_is_removed(table: pa.Table, tmp_path: Path) -> None:
    (tmp_path / "time.png").write_bytes(b"of earlier rows")
    assert draw_timing_plot(table, tmp_path / "time.png", "Nothing") == []
    assert not list(tmp_path.iterdir())


def test_each_solver_is_a_curve_in_seconds_and_its_fitted_power_is_stated() -> None:
    (frame,) = build_timing_chart(read_run_times(rows())).frames
    assert "Fitted powers of the vertices, cloth: sparse n^1.0, dense n^2.0, xpbd n^1.5." in frame.notes
    curves = {series.label: series.columns for series in frame.series}
    assert curves["sparse"]["vertices"] == [64, 256, 1024]
    assert curves["sparse"]["step"] == pytest.approx([6.4e-5, 2.56e-4, 1.024e-3])
    cold, warm = (np.array(curves["sparse"][name]) for name in ("cold", "warm"))
    assert cold == pytest.approx(8 / 3 * warm)
    (frame,) = build_timing_chart(read_run_times(rows(sizes=(8, 16)))).frames
    assert not any("powers" in note for note in frame.notes), "two sizes give none"


def test_a_curve_whose_larger_sizes_failed_ends_in_a_cross_with_the_reason() -> None:
    (frame,) = build_timing_chart(read_run_times(rows(failed=[(16, "dense"), (32, "dense"), (8, "xpbd")]))).frames
    assert {series.label: series.status for series in frame.series} == {
        "sparse": "ok",
        "xpbd": "ok",
        "dense": "diverged",
    }
    assert f"× Failed on cloth (diverged, {EXPLOSION}): xpbd 8, dense 16, dense 32." in frame.notes


def test_solvers_have_marks_of_their_own_that_stay_the_same() -> None:
    names = [f"method-{k:02}" for k in range(20)]
    assert len(set(assign_solver_styles(names).values())) == 20 + len(SOLVER_TABLE), (
        "colour and marker together tell solvers apart"
    )
    for solver in SOLVER_TABLE:
        assert assign_solver_styles([])[solver] == assign_solver_styles(names)[solver]
    assert assign_solver_styles(names) == assign_solver_styles(reversed(names))


def test_the_summary_has_a_line_for_each_run() -> None:
    console = Console(width=200, record=True, file=StringIO())
    table = rows(sizes=(10,), failed=[(10, "dense")])
    console.print(build_summary_table(read_run_times(table), table))
    lines = [" ".join(line.split()) for line in console.export_text().splitlines()]
    assert "cloth: times in milliseconds, medians over the rounds and over the steps" in lines
    assert "10 sparse 0.8 0.3 0.1 0.099 0.01 0.02 10 max-iter 1.0e-04 40 % 4 %" in lines
    assert f"10 dense{7 * ' –'} diverged{3 * ' –'}" in lines


def test_the_summary_and_the_words_after_it_fit_a_hundred_columns() -> None:
    scenes, sizes = ("hanging-cloth", "a-scene-with-a-long-name"), (8, 32)
    table = rows(scenes=scenes, sizes=sizes, solvers=("local-global-sparse", "dense"), omegas=(1.0, 1.25))
    console = Console(width=240, record=True, file=StringIO())
    console.print(build_summary_table(read_run_times(table), table))
    assert max(len(line.rstrip()) for line in console.export_text().splitlines()) <= 100
    assert max(map(len, summarise_sweep(read_run_times(table)))) <= 98, "two more go before each"


def summarise_changed_rows(
    solvers: Sequence[str], sizes: Sequence[int] = (20,), **by: Callable[[dict[str, Any]], Any]
) -> list[str]:
    """What is learned of rows whose columns are changed where they are not null."""
    given_rows = rows(sizes=sizes, solvers=solvers).to_pylist()
    for row in given_rows:
        row |= {name: change(row) for name, change in by.items() if row[name] is not None}
    return learned_from(given_rows)


def test_times_are_compared_at_equal_errors_by_the_median_step() -> None:
    (speed, limit) = summarise_rows(sizes=(10, 20), failed=[(20, "dense")])
    assert speed.startswith("cloth 10: fastest at equal accuracy is sparse, 0.1 ms a step; xpbd 10 times, dense 100")
    assert "(largest residual 1.0e+00 to 10 times that" in speed
    assert limit.startswith("All 5 runs stopped at the limit of iterations")
    assert max(read_run_times(rows()), key=lambda run: run.worst_residual or 0.0).worst_residual == 1.0, (
        "of the first frame"
    )


def test_times_at_unequal_or_unknown_errors_are_not_compared() -> None:
    worse = summarise_changed_rows(
        ("sparse", "dense"), residual=lambda row: row["residual"] * (100 if row["solver"] == "dense" else 1)
    )
    assert worse[0].startswith("cloth 20: most accurate is sparse, largest residual 1.0e+00; no other")
    assert worse[1] == "cloth 20: not compared with it: dense (its error is 100 times as large)."
    unknown = summarise_changed_rows(
        ("sparse", "xpbd"), residual=lambda row: None if row["solver"] == "xpbd" else row["residual"]
    )
    assert unknown[1] == "cloth 20: not compared with it: xpbd (its error is unknown)."
    once = summarise_changed_rows(
        ("sparse", "xpbd"), residual=lambda row: None if row["frame"] == 2 else row["residual"]
    )
    assert once[0] == "cloth 20: times are not compared, for no run's error is known."
    assert not [line for line in worse + unknown + once if "fastest" in line or "times as long" in line]


def test_residuals_at_round_off_are_equal_and_their_runs_were_not_cut_short() -> None:
    given_rows = rows(sizes=(20,), solvers=("sparse", "dense")).to_pylist()
    for row in given_rows:
        if row["phase"] == "step":
            row |= {"residual": 0.0 if row["solver"] == "sparse" else 7e-16, "termination_reason": "max-iter"}
            row |= {"residual_initial": 1e-3, "energy_force": -1e-6}  # round-off of both: 1e-15
    (speed,) = learned_from(given_rows)
    assert "fastest at equal accuracy is sparse, 0.4 ms a step; dense 400 times as long" in speed
    for row in given_rows:
        row["residual_initial"] = 1e-6 if row["residual_initial"] else None  # the energy's square root is what is left
    assert len(learned_from(given_rows)) == 1
    for row in given_rows:
        row["energy_force"] = 0.0
    assert learned_from(given_rows)[1].endswith("dense (its error is 700 times as large).")


def test_verified_runs_are_compared_by_their_distance_from_the_reference() -> None:
    given_rows = rows(sizes=(20,), solvers=("sparse", "dense")).to_pylist()
    for row in given_rows:
        if row["phase"] == "step":
            row["reference_distance"] = 1e-3 if (row["solver"], row["frame"]) == ("dense", 3) else 1e-5
    assert "largest distance from the reference 1.0e-05" in learned_from(given_rows)[0]
    assert "dense (its error is 100 times as large)" in learned_from(given_rows)[1]


def test_steps_of_other_lengths_or_integrators_are_not_compared() -> None:
    given_rows = rows(sizes=(20,), solvers=("sparse", "dense")).to_pylist()
    for name, other in (("time_step", 0.02), ("integrator", "bdf2"), ("error_requested", 1e-3)):
        mixed = [row | ({name: other} if row["solver"] == "dense" else {}) for row in given_rows]
        assert not [line for line in learned_from(mixed) if "fastest" in line or "compared" in line], name


def test_a_limit_of_iterations_stops_only_what_has_one() -> None:
    own = summarise_changed_rows(("sparse", "xpbd"), is_substepping=lambda row: True)
    assert own[-1].startswith("All 2 runs stopped"), "of others it is not known"
    given_rows = rows(sizes=(20,), solvers=("sparse", "symplectic-euler")).to_pylist()
    for row in given_rows:
        row["is_substepping"] = row["solver"] == "symplectic-euler"
    assert learned_from(given_rows)[-1].startswith("1 of 2 runs stopped at the limit of iterations")
    sparse, explicit = read_run_times(pa.Table.from_pylist(given_rows, schema=RUN_SCHEMA))
    assert (sparse.termination_reason, explicit.termination_reason) == ("max-iter", "converged")
    for row in given_rows:
        row["num_iterations"] = row["num_iterations"] and 1  # of 10 that were allowed, as of one linear solve a step
    assert not [line for line in learned_from(given_rows) if "limit" in line]


def strains(largest: Sequence[float], below: Sequence[float], exponent: int | None, stopped: str) -> list[str]:
    """What is learned of one solver's strains at sizes 3 and 9."""
    given_rows = rows(sizes=(3, 9), solvers=("sparse",)).to_pylist()
    for row in given_rows:
        k = int(row["size"] == 9)
        if row["phase"] == "step":
            row |= {"max_strain": largest[k], "strain_p99": below[k], "termination_reason": stopped}
            row |= {"modulus_exponent": exponent, "residual": 1.0}
    return learned_from(given_rows)


def test_strains_of_two_sizes_are_reported_with_what_happens_to_the_material() -> None:
    (point,) = strains((0.05, 0.2), (0.04, 0.04), 0, "converged")
    assert "from 5 to 20 %, from size 3 to 9, where 99 % of the springs stay below 4 and 4 %: the material is" in point
    (unknown,) = strains((0.05, 0.2), (0.04, 0.04), None, "converged")
    assert "is a point load" in unknown
    assert "material" not in unknown
    (block,) = strains((0.05, 0.2), (0.04, 0.02), -1, "converged")
    assert "so does the material: by the springs' rule its modulus is proportional to h^-1" in block
    (chain,) = strains((0.085, 0.287), (0.08, 0.28), 1, "converged")
    assert "proportional to h, h the spacing" in chain
    (both,) = strains((0.085, 0.287), (0.08, 0.28), 0, "converged")
    assert both.endswith("the material is the same, but strains have not converged by these sizes.")
    assert strains((0.05, 0.06), (0.04, 0.05), 0, "converged") == []
    (limit,) = strains((0.05, 0.2), (0.04, 0.04), 0, "max-iter")
    assert limit.startswith("All 2 runs"), "of strains that were not solved for nothing is said"


def test_the_modulus_follows_the_spacing_by_rule_and_dimension() -> None:
    for dimension, mesh in ((1, "chain"), (2, "grid"), (3, "block")):
        for rule in SCALING_RULES:
            if rule == "area":
                continue  # of meshes from files, which have no spacing
            by_size: dict[int, float] = {}
            for size in (3, 5):
                made = load_target(MESH_CLASSES[mesh]).model_validate({"kind": mesh}).build_mesh(size)
                assert made.dimension == dimension
                reference = 3 if rule == "liu2013" else None
                k = compute_spring_stiffness(
                    made, scaling_rule=rule, stretch=7.0, shear=0.0, bend=0.0, reference_size=reference
                )
                stretch = float(np.median(k[made.spring_families[STRETCH]]))
                by_size[size] = stretch * made.spacing ** (2 - dimension)  # EA = k h, E t = k, E = k / h
                spacing = made.spacing
            expected = 2.0 ** -compute_modulus_exponent(rule, dimension)
            assert by_size[5] / by_size[3] == pytest.approx(expected), (rule, mesh, spacing)


def test_a_sweep_ends_with_three_commands_and_one_link(tmp_path: Path) -> None:
    table, config = rows(scenes=("hanging-cloth",)), ROOT / "configs" / "quickstart.yaml"
    results = tmp_path / "my results"
    (results / "q" / "recordings").mkdir(parents=True)
    seen = results / "q" / "recordings" / "hanging-cloth-32-sparse-hanging-cloth 32 sparse 1.0.rrd"
    seen.touch()
    timed_runs = read_run_times(table)
    lines = build_closing_lines(timed_runs, config, results, results / "q")
    commands = [shlex.split(line) for line in lines if line.startswith("  springbench")]
    scene = str(ROOT / "configs" / "scenes" / "hanging-cloth.yaml")
    assert commands == [
        ["springbench", "view", str(seen)],
        ["springbench", "recommend", "--error", "1e-2", scene],
        ["springbench", "report", str(results)],
    ]
    (results / "index.html").touch()
    assert build_closing_lines(timed_runs, config, results, results / "q")[-1].endswith("/my%20results/index.html")


def test_the_summary_marks_unreliable_times_and_states_why() -> None:
    given_rows = rows(sizes=(10,), solvers=("sparse",)).to_pylist()
    for row in given_rows:
        row["preempted"] = row["phase"] == "step" and row["frame"] == 2
        row["phases_consistent"] = False if row["phase"] in ("local", "global") else None
    console = Console(width=200, record=True, file=StringIO())
    table = pa.Table.from_pylist(given_rows, schema=RUN_SCHEMA)
    console.print(build_summary_table(read_run_times(table), table))
    text = " ".join(console.export_text().split())
    assert "10 sparse 0.8 0.3 0.1! 0.099 0.01~ 0.02~ 10" in text
    assert PREEMPTED_NOTE in text
    assert INCONSISTENT_NOTE in text
    table = rows(sizes=(10,), solvers=("sparse",))
    console.print(build_summary_table(read_run_times(table), table))
    text = " ".join(console.export_text().split())
    assert not {"!", "~"} & set(text.split("below")[-1]), "rows that say nothing of it have no marks"


def test_the_plot_of_times_is_drawn_again_only_if_its_runs_have_changed(tmp_path: Path, monkeypatch):
    drawn: list[str] = []

    def draw(*given: Any) -> None:
        drawn.append(given[4])
        draw_timing_plot(*given)

    monkeypatch.setattr(timing_plot, "draw_timing_plot", draw)
    (tmp_path / "pictures").mkdir()
    run: Any = SimpleNamespace(pictures=True, record=False)
    jobs, table = [PictureJob(run, tmp_path, tmp_path)], rows(sizes=(8,), solvers=("sparse", "dense"))
    stale = table["run_id"][0].as_py()
    for more, stale_ids in ((table, ()), (table, ()), (table, {stale}), (table, {stale, "of another sweep"})):
        draw_sweep_pictures("Sweep", jobs, tmp_path, more, print, stale_ids=stale_ids)
    draw_sweep_pictures("Sweep", jobs, tmp_path, rows(sizes=(8,)), print, stale_ids={stale})
    assert len(drawn) == len(set(drawn)) == 3
    (tmp_path / "pictures" / "timing.png").write_bytes(b"no picture")
    draw_sweep_pictures("Sweep", jobs, tmp_path, rows(sizes=(8,)), print, stale_ids={stale})
    assert len(drawn) == 4
