"""Runs that are not about times: one pass, the same positions, and certificates of what it finds."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from springbench.harness.config.config_loader import load_config
from springbench.harness.errors import InputError
from springbench.harness.experiments.run_pipeline import execute_run
from springbench.harness.experiments.sweep_plan import RunFiles
from springbench.harness.report.intersection_certificates import write_certificates
from springbench.harness.results.run_schema import RUN_SCHEMA

SCENE = """
mesh: {kind: grid}
mass: 1
time_step: 0.1
frames: 3
default_size: 3
effects: [{kind: springs, stretch: 10}, {kind: gravity}, {kind: self-contact}]
"""


def execute_with_timing(folder: Path, timing: str) -> tuple[list[dict[str, Any]], list[str]]:
    """The rows of a run, and the passes that it reported."""
    (folder / "scene.yaml").write_text(SCENE)
    options: dict[str, Any] = {"solvers": ["newton"], "timing": timing, "record": False, "rtol": 1e-3}
    (spec,) = load_config(folder / "scene.yaml", **options).list_runs()
    files, messages = RunFiles.for_run(spec, folder), list[str]()
    files.rows_path.parent.mkdir(exist_ok=True)
    return execute_run(spec, files, messages.append), messages


def test_an_untimed_run_does_its_steps_once_and_ends_where_a_timed_one_does(tmp_path: Path):
    (timed, _), (rough, passes) = execute_with_timing(tmp_path, "exclusive"), execute_with_timing(tmp_path, "none")
    assert [(row["phase"], row["frame"]) for row in rough] == [("prepare", None), ("step", 1), ("step", 2), ("step", 3)]
    assert passes.count("second pass") == 3
    assert {said for said in passes if "pass" in said} == {"second pass"}
    digests = {row["frame"]: row["positions_digest"] for row in timed if row["phase"] == "step"}
    assert {row["frame"]: row["positions_digest"] for row in rough if row["phase"] == "step"} == digests
    assert all(row["seconds"] > 0 and row["timing"] == "none" and row["status"] == "ok" for row in rough)
    assert len({row["run_id"] for row in (timed[0], rough[0])}) == 2


def test_certificates_count_intersection_free_frames(tmp_path: Path):
    rows, _ = execute_with_timing(tmp_path, "none")
    rows += [row | {"run_id": "other", "solver": "broken", "num_intersections": int(row["frame"] == 2)} for row in rows]
    rows.append(rows[0] | {"run_id": "none", "solver": "refuses", "phase": "run", "status": "unsupported"})
    (path,) = write_certificates(pa.Table.from_pylist(rows, schema=RUN_SCHEMA), tmp_path)
    with path.open() as file:
        found = {
            row["solver"]: (row["num_frames"], row["num_intersection_free_frames"], row["status"])
            for row in csv.DictReader(file)
        }
    assert found == {"newton": ("3", "3", "ok"), "broken": ("3", "2", "ok"), "refuses": ("", "0", "unsupported")}


def test_an_untimed_run_writes_no_recording(tmp_path: Path):
    (tmp_path / "scene.yaml").write_text(SCENE)
    with pytest.raises(InputError, match=r"options: timing: .*set `record: false`|timing.*record: false"):
        load_config(tmp_path / "scene.yaml", timing="none")
