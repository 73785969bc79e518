"""Rows from strangers: what is invalid is named and left out, the rest is shown, none is trusted."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rich.console import Console
from springbench.harness.errors import InputError
from springbench.harness.report.median_times import write_medians
from springbench.harness.report.site.data_scripts import write_script
from springbench.harness.report.site.sweep_folders import locate_folder
from springbench.harness.report.sweep_summary import summarise_sweep
from springbench.harness.report.timing_plot import draw_timing_plot
from springbench.harness.report.timing_table import build_summary_table, read_run_times
from springbench.harness.results.parquet_rows import read_rows
from springbench.harness.results.row_store import FILE_COLUMN

from tests import synthetic_accuracy_rows, synthetic_site_rows
from tests.contracts.attempts import Outcome, attempt
from tests.contracts.hostile_rows import LEFT_OUT, ODD_COLUMNS, rows_with, write_cases


def run_report(folder: Path) -> Outcome:
    found = attempt(folder, ["report", "results", "--no-viewer"])
    assert not found.error, found.error
    assert "Traceback" not in found.said
    assert not found.outside
    return found


def test_rows_that_do_not_fit_are_named_and_left_out(tmp_path: Path):
    files = write_cases(tmp_path / "results" / "cases", LEFT_OUT)
    found = run_report(tmp_path)
    said = "".join(found.said.split())
    assert found.code == 0
    for file, (name, (column, _)) in zip(files, LEFT_OUT.items(), strict=True):
        assert f"{file.name}:{column}:got" in said, name
    assert not list(tmp_path.parent.rglob("evil*"))


def test_odd_rows_that_fit_are_shown(tmp_path: Path):
    write_cases(tmp_path / "results" / "cases", ODD_COLUMNS)
    found = run_report(tmp_path)
    assert found.code == 0
    assert ".parquet" not in found.said
    table = (tmp_path / "results" / "site" / "data" / "cases" / "runs.js").read_text()
    assert f'"num_rows":{2 * len(ODD_COLUMNS)},' in table


@pytest.mark.long
@pytest.mark.parametrize("name", ODD_COLUMNS)
def test_odd_rows_are_reported_at_the_end_of_a_sweep(tmp_path: Path, name: str):
    table = read_rows(write_cases(tmp_path / "cases", {name: ODD_COLUMNS[name]}))
    Console(file=StringIO()).print(build_summary_table(read_run_times(table), table))
    summarise_sweep(read_run_times(table))
    draw_timing_plot(table, tmp_path / "timing.png", name)
    write_medians(table, tmp_path)


FILES = {
    "a column twice": lambda path: pq.write_table(
        pa.table([pa.array(["a"]), pa.array(["b"])], names=["run_id", "run_id"]), path
    ),
    "a column of files": lambda path: pq.write_table(
        rows_with("reason", "").append_column(FILE_COLUMN, [["x"] * 32]), path
    ),
    "a size in words": lambda path: pq.write_table(pa.table({"run_id": ["a"], "size": ["four"]}), path),
    "a status in a list": lambda path: pq.write_table(pa.table({"run_id": ["a"], "status": [["ok"]]}), path),
    "text that is no UTF-8": lambda path: pq.write_table(
        pa.table({"run_id": pa.array([b"\xff\xfe"], pa.binary()).cast(pa.string(), safe=False)}), path
    ),
    "a text of 1 MB a million times": lambda path: pq.write_table(
        pa.table(
            {"run_id": pa.DictionaryArray.from_arrays(pa.array([0] * 1_000_000, pa.int32()), pa.array(["x" * 10**6]))}
        ),
        path,
    ),
    "3 million zeros": lambda path: pq.write_table(pa.table({"size": pa.array([0] * 3_000_000)}), path),
}


@pytest.mark.parametrize("name", FILES)
def test_a_hostile_file_of_rows_is_named_within_limits(tmp_path: Path, name: str):
    folder = tmp_path / "results" / "a" / "rows"
    folder.mkdir(parents=True)
    FILES[name](folder / "hostile.parquet")
    found = run_report(tmp_path)
    assert found.code == 2
    assert "hostile.parquet" in "".join(found.said.split())


@pytest.mark.parametrize("unit", ["../../evil", "/evil", "..", "", ".hidden", "a/b", "x" * 300, "a\0b"])
def test_a_unit_of_packed_rows_is_no_path(tmp_path: Path, unit: str):
    folder = synthetic_site_rows.write_site_results(tmp_path / "results", 2)
    packed = pq.read_table(folder / "rows.parquet")
    pq.write_table(
        packed.set_column(packed.column_names.index(FILE_COLUMN), FILE_COLUMN, [[unit] * len(packed)]),
        folder / "rows.parquet",
    )
    found = run_report(tmp_path)
    assert found.code == 2
    assert "rows.parquet" in "".join(found.said.split())


@pytest.mark.parametrize(
    "recording", ["/etc/hostname", "../../secret.rrd", "a/../../secret.rrd", "a\0b", "recordings/" + "x" * 300]
)
def test_a_recording_is_searched_below_its_folder(tmp_path: Path, recording: str):
    given_rows = synthetic_accuracy_rows.build_snapshot_rows("net", 6, "early") + list(
        synthetic_accuracy_rows.build_curve_rows("net", 6, "early", "numba")
    )
    for row in given_rows:
        if row["kind"] == "curve":
            row["recording_path"] = recording
    synthetic_accuracy_rows.write_accuracy_rows(tmp_path / "results" / "study", given_rows)
    found = run_report(tmp_path)
    assert "recording_path: got" in " ".join(found.said.split())


def test_rows_of_accuracy_that_do_not_belong_together_are_refused(tmp_path: Path):
    given_rows = synthetic_accuracy_rows.build_snapshot_rows("net", 6, "early") + list(
        synthetic_accuracy_rows.build_curve_rows("net", 6, "early", "numba")
    )
    for row in given_rows:
        row["objective_initial"] = row["time_step"] = None
    synthetic_accuracy_rows.write_accuracy_rows(tmp_path / "results" / "study", given_rows)
    assert run_report(tmp_path).code in (0, 2)


def test_a_strict_read_reports_every_file(tmp_path: Path):
    files = write_cases(tmp_path / "cases", dict(list(LEFT_OUT.items())[:2]))
    with pytest.raises(InputError) as raised:
        read_rows(files)
    assert [(mistake.key, mistake.file) for mistake in raised.value.mistakes] == [("run_id", file) for file in files]


def test_folders_have_safe_links_and_names_of_their_own():
    names = ["javascript:alert(1)", "a b", "a~b", "a/b", "a", "this", "..x", "ä", "%2e%2e", "a?b#c", "x" * 200]
    found = [locate_folder(Path("results", name), Path("results")) for name in [*names, "."]]
    assert len({folder.slug for folder in found}) == len(found)
    for folder in found:
        assert folder.relative_url.startswith("./")
        assert not set(folder.relative_url) & set(":?#& "), folder.relative_url
        assert set(folder.slug) <= set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789._~-"), (
            folder.slug
        )
        assert len(folder.slug) < 120
    assert found[0].relative_url == "./javascript%3Aalert%281%29/"
    assert [folder.slug for folder in found[3:5]] == ["a~b", "a"]


def test_a_key_is_never_the_prototype_of_what_a_script_gives(tmp_path: Path):
    value = {"__proto__": 1, 'a"__proto__': 2, "b": '"__proto__":'}
    words = write_script(tmp_path / "x.js", "x", value).read_text()
    assert words.count('["__proto__"]:') == 1
    assert (
        json.loads(words.partition(", ")[2].strip().removesuffix(");").replace('["__proto__"]:', '"__proto__":', 1))
        == value
    )
