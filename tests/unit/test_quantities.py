"""One run's quantities have the same value wherever they are stated, each by a hand-computed case."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console
from springbench.harness.recording.recorder_interface import RecordingReplay
from springbench.harness.report import comparison_picture
from springbench.harness.report.ablation_summary import build_ablation_table
from springbench.harness.report.charts.published_curves import PUBLISHED_LABEL
from springbench.harness.report.drawable_frames import max_recorded_strain, strain_extremes
from springbench.harness.report.equal_accuracy import compare_runs
from springbench.harness.report.equal_accuracy import describe_comparison as compared
from springbench.harness.report.figures.timing_panels import list_timing_panels
from springbench.harness.report.median_times import write_medians
from springbench.harness.report.recorded_strain import mean_rest_length
from springbench.harness.report.robustness import CORRECT, classify_run
from springbench.harness.report.site import update_page
from springbench.harness.report.timing_table import build_summary_table, label_runs, read_run_times
from springbench.harness.results.quantities import compute_max_strain as largest_of
from springbench.harness.results.quantities import compute_ms_per_step, compute_slowdown
from springbench.harness.results.run_schema import RUN_SCHEMA

from tests import synthetic_site_rows

MILLISECONDS = {"sparse": [1.0, 2.0, 9.0, 3.0, 4.0, 50.0], "numba": [1.5, 0.5, 0.25, 2.0, 40.0, 1.0]}
"""Of two rounds of three frames: medians 3.5 and 1.25, means 11.5 and 7.5, least 1 and 0.25."""
STRAINS = (0.389, 0.284, 0.2)


def rows_of(solver: str) -> list[dict[str, Any]]:
    number = synthetic_site_rows.SOLVER_NAMES.index(solver)
    same = synthetic_site_rows.build_run_columns(number) | {
        "phase": "step",
        "num_iterations": 5,
        "termination_reason": "converged",
        "residual": 1e-6,
    }
    return [
        same
        | {"frame": k % 3 + 1, "round": k // 3, "seconds": 1e-3 * ms}
        | {"max_strain": STRAINS[k % 3], "strain_p99": 0.1}
        for k, ms in enumerate(MILLISECONDS[solver])
    ]


def replay_of(solver: str) -> RecordingReplay:
    """A single spring of length 1, stretched in each frame as the rows say, and more at the start."""
    stretched = np.array([[[0, 0, 0], [1 + strain, 0, 0]] for strain in (0.9, *STRAINS)], np.float32)
    own = {"scene": "hanging-cloth", "size": 8, "solver": solver}
    return RecordingReplay(
        title="", run_id="", frames=np.arange(4), times=np.arange(4.0), positions=stretched,
        triangles=np.zeros((0, 3), np.int64), springs=np.array([[0, 1]]), rest_lengths=np.ones(1),
        pinned_vertices=np.zeros(0, np.int64), strain_range=0.1,
        scalars={"/max_strain": (np.arange(4), np.array([0.9, *STRAINS])), "/residual": (np.arange(1), np.ones(1))},
        properties=own | {"milliseconds_per_step": compute_ms_per_step([1e-3 * ms for ms in MILLISECONDS[solver]])},
    )  # fmt: skip


def test_every_place_states_the_same_numbers_of_a_run(tmp_path: Path):
    given_rows = rows_of("sparse") + rows_of("numba")
    table = pa.table(
        {field.name: [row.get(field.name) for row in given_rows] for field in RUN_SCHEMA}, schema=RUN_SCHEMA
    )
    (tmp_path / "made" / "rows").mkdir(parents=True)
    pq.write_table(table, tmp_path / "made" / "rows" / "all.parquet")

    sparse, numba = read_run_times(table)
    assert (sparse.step, numba.step) == pytest.approx((3.5, 1.25))
    assert sparse.least == pytest.approx(1.0)
    assert sparse.max_strain == pytest.approx(0.389)

    console = Console(width=200, record=True, file=StringIO())
    console.print(build_summary_table(read_run_times(table), table))
    assert re.search(r"8 sparse +– +– +3\.5 +1 .* 38\.9 % +10 %", console.export_text())

    for run in (sparse, numba):
        facts = comparison_picture._collect_facts(replay_of(run.solver), replay_of("sparse"))  # pyright: ignore[reportPrivateUsage]
        assert facts["ms a step"] == {"sparse": "3.5", "numba": "1.25"}[run.solver]
        assert facts["largest strain"] == "38.9 %"

    ((words, _),) = [
        said for one in compare_runs(read_run_times(table)) for said in compared(one, label_runs(read_run_times(table)))
    ]
    assert "fastest at equal accuracy is numba, 1.25 ms a step; sparse 2.8 times as long" in words

    update_page(tmp_path)
    page = (tmp_path / "site" / "data" / "made" / "runs.js").read_text()
    columns = json.loads(page.partition(", ")[2].strip().removesuffix(");"))["columns"]
    assert columns["step"] == [1.25, 3.5]
    assert columns["max_strain"] == [0.389, 0.389]
    index = (tmp_path / "site" / "data" / "index.js").read_text()
    assert "numba, 1.25 ms a step; sparse 2.8 times as long" in index

    (path,) = write_medians(table, tmp_path)
    with path.open() as file:
        assert {row["solver"]: float(row["median_seconds"]) for row in csv.DictReader(file)} == pytest.approx(
            {"sparse": 3.5e-3, "numba": 1.25e-3}
        )
    plot: Any = next(
        entry for entry in list_timing_panels(tmp_path / "made", lambda rows: ()) if "step" in entry.name
    ).build_panel()
    own = [series for series in plot.series if series.label != PUBLISHED_LABEL]
    assert sorted(float(series.x[0]) for series in own) == pytest.approx([1.25e-3, 3.5e-3])


def test_the_largest_strain_leaves_the_start_out_and_no_frame_after_it():
    replay = replay_of("sparse")
    assert max_recorded_strain(replay) == 0.389
    assert strain_extremes([replay]) == pytest.approx((0.0, 0.389), abs=1e-12)
    bare = replace(replay, scalars={})
    assert max_recorded_strain(bare) == pytest.approx(0.389, abs=1e-6)
    squeezed = replace(bare, positions=replay.positions * np.float32(0.5))
    assert strain_extremes([squeezed, replay]) == pytest.approx((-0.4, 0.389), abs=1e-6)
    assert np.isnan(largest_of(np.array([0]), np.array([0.9])))


def test_times_as_long_is_the_quotient_of_ms_a_step():
    assert compute_slowdown(3.5, 1.25) == pytest.approx(2.8)
    assert compute_ms_per_step([0.001, 0.002, 0.009]) == pytest.approx(2.0), "the median, where the mean is 4"


def test_a_distance_in_pictures_is_the_largest_in_mean_rest_lengths():
    line = np.array([[[0, 0, 0], [1, 0, 0], [2, 0, 0], [12, 0, 0]]], np.float32)
    springs, lengths = np.array([[0, 1], [1, 2], [2, 3]]), np.array([1.0, 1.0, 10.0])
    best = replace(replay_of("sparse"), frames=np.array([3]), positions=line, springs=springs, rest_lengths=lengths)
    moved = replace(best, positions=line + np.array([[0, 0, 0], [0, 0, 0], [0, 2, 0], [0, 6, 0]], np.float32))
    assert mean_rest_length(best) == pytest.approx(4.0), "the mean of 1, 1 and 10; the median is 1"
    assert comparison_picture.format_distance(moved, best) == "1.5", "6 m of 4; the mean distance is 2"


def test_the_share_of_an_effect_is_of_the_whole_step():
    plain = {
        "memory_bytes": 1024,
        "nnz_factor": None,
        "status": "ok",
        "name": "wind",
        "displacement_max": 1.0,
        "displacement_rms": 1.0,
    }
    plain |= {
        "energy_difference": 0.1,
        "centroid_displacement": 0.1,
        "added_seconds": 5e-4,
        "added_seconds_low": 4e-4,
        "added_seconds_high": 6e-4,
        "seconds": 2e-3,
    }
    table = build_ablation_table([plain | {"kind": "full-scene"}, plain | {"kind": "ablated"}])
    console = Console(width=200, record=True, file=StringIO())
    console.print(table)
    # 0.5 ms of 2; of the 1.5 that are left it would be a third.
    assert re.search(r"wind +0\.5 +25\.0 +20\.0 to 30\.0", console.export_text())


def test_a_motion_within_one_percent_of_the_reference_is_the_same():
    solved = {
        "status": "ok",
        "stationarity": 1e-9,
        "stationarity_above_roundoff": 1e-9,
        "residual_rtol": 1e-6,
        "is_local_minimum": True,
        "is_degenerate": False,
    }
    for distance, same in ((0.0, True), (0.0099, True), (0.0101, False), (0.03, False)):
        frames = [
            solved | {"termination_reason": "converged", "reference_distance": deviation}
            for deviation in (0.0, distance, 0.0)
        ]
        found = classify_run(frames)
        assert (found.outcome, found.same_motion) == (CORRECT, same), distance
