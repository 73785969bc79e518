"""Merging results: nothing is lost, nothing is doubled, and what should be equal and is not is reported."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from springbench.harness.errors import InputError
from springbench.harness.experiments.archive.compaction import compact_results
from springbench.harness.experiments.archive.result_merge import MergeReport, merge_results
from springbench.harness.results import parquet_rows, row_store

from tests.synthetic_run_rows import build_dummy_rows, write_dummy_runs


def merge_folders(folder: Path, *names: str) -> MergeReport:
    return merge_results([folder / name for name in names], folder / "all", lambda line: None)


def rewrite_rows(unit: Path, **changed: Any) -> None:
    """A unit's rows with other values."""
    parquet_rows.write_rows(unit, [row | changed for row in build_dummy_rows(int(unit.stem[-12:], 16))])


@pytest.fixture
def two(tmp_path: Path) -> Path:
    """A folder of `a` and `b`, results of a sweep each, of which run 2 is in both; `b` is packed."""
    for name, first in (("a", 0), ("b", 2)):
        units = write_dummy_runs(tmp_path / name / "sweep", 3, first_number=first)
        for part, kind in (("recordings", "rrd"), ("pictures", "png")):
            (tmp_path / name / "sweep" / part).mkdir()
            for unit in units:
                (tmp_path / name / "sweep" / part / f"{unit.stem}.{kind}").write_text(name)
    compact_results(tmp_path / "b", lambda line: None)
    return tmp_path


def test_all_runs_are_there_once_with_their_recordings_and_again_changes_nothing(two: Path):
    found = merge_folders(two, "a", "b")
    assert found == MergeReport(5, 1, [], [], found.machine_summary)
    units = row_store.list_units(two / "all" / "sweep" / "rows")
    assert sorted(set(map(str, parquet_rows.read_rows(units)["run_id"].to_pylist()))) == [f"{k:012x}" for k in range(5)]
    for part in ("recordings", "pictures"):
        assert [path.stem for path in sorted((two / "all" / "sweep" / part).iterdir())] == [u.stem for u in units]
    before = {path: path.stat().st_mtime_ns for path in two.rglob("*") if path.is_file()}
    assert merge_folders(two, "b", "a").num_written == 0
    assert {path: path.stat().st_mtime_ns for path in two.rglob("*") if path.is_file()} == before


def test_a_run_that_was_done_twice_has_both_rows_and_the_newer_has_its_name(two: Path):
    (unit,) = (unit for unit in row_store.list_units(two / "a" / "sweep" / "rows") if unit.stem.endswith("2"))
    rewrite_rows(unit, started_at="2027-01-01T00:00:00+00:00", seconds=9.0)
    for order in (("a", "b"), ("b", "a")):
        found = merge_results([two / name for name in order], two / f"all-{order[0]}", lambda line: None)
        assert found == MergeReport(6, 0, [], [], found.machine_summary)
        there = [u for u in row_store.list_units(two / f"all-{order[0]}" / "sweep" / "rows") if unit.stem in u.stem]
        assert [parquet_rows.read_rows([u])["seconds"][0].as_py() for u in there] == [9.0, 0.003]
        assert there[0].stem == unit.stem
        assert there[1].stem.startswith(f"{unit.stem}~")


def test_positions_that_differ_are_a_conflict_on_one_machine_and_reported_between_two(two: Path):
    (unit,) = (unit for unit in row_store.list_units(two / "a" / "sweep" / "rows") if unit.stem.endswith("2"))
    rewrite_rows(unit, positions_digest="f" * 64)
    found = merge_folders(two, "a", "b")
    assert found.conflicts == found.cross_machine_differences == ["scene2 10 hybrid: from step 1"]
    parquet_rows.write_rows(
        unit.with_name("there.parquet"),
        [r | {"positions_digest": "e" * 64, "run_id": "e"} for r in build_dummy_rows(2)],
    )
    unit.unlink()
    found = merge_results([two / "a", two / "b"], two / "others", lambda line: None)
    assert (found.conflicts, found.cross_machine_differences) == ([], ["scene2 10 hybrid: from step 1"])


def test_folders_that_look_like_columns_or_patterns_are_merged_as_all_are(two: Path):
    for name, other in (("a", "size=64"), ("b", "solver=x[1]")):
        (two / name).rename(two / other)
    merge_results([two / "size=64", two / "solver=x[1]"], two / "status=failed", lambda line: None)
    found = parquet_rows.read_rows_by_file(row_store.list_units(two / "status=failed" / "sweep" / "rows"))
    expected = [row for number in range(5) for row in build_dummy_rows(number)]
    for name in ("run_id", "size", "solver", "status"):
        assert found[name].to_pylist() == [row[name] for row in expected]


def test_rows_that_are_not_written_as_they_were_replace_nothing(two: Path, monkeypatch: pytest.MonkeyPatch):
    merge_folders(two, "a")
    before = {path: path.read_bytes() for path in (two / "all").rglob("*.parquet")}
    (unit,) = (unit for unit in row_store.list_units(two / "a" / "sweep" / "rows") if unit.stem.endswith("2"))
    rewrite_rows(unit, started_at="2027-01-01T00:00:00+00:00")
    write = pq.write_table
    monkeypatch.setattr(pq, "write_table", lambda table, file: write(table.slice(1), file))
    with pytest.raises(InputError, match="differ from those written"):
        merge_folders(two, "a")
    assert {path: path.read_bytes() for path in (two / "all").rglob("*.parquet")} == before


def test_a_column_of_another_type_is_named_before_anything_is_written(two: Path):
    unit = row_store.list_units(two / "a" / "sweep" / "rows")[1]
    table = pq.read_table(unit)
    for name, values in (("size", ["large", "small"]), ("positions_digest", [1.5, 2.5])):
        pq.write_table(table.set_column(table.schema.get_field_index(name), name, pa.array(values)), unit)
        with pytest.raises(InputError, match=rf"{unit.name}: rows do not fit .*{name}"):
            merge_folders(two, "b", "a")
    assert not (two / "all").exists()


def test_what_cannot_be_merged_is_the_users_mistake(two: Path):
    with pytest.raises(InputError, match="of one kind"):
        merge_results([two / "a", two / "b" / "sweep"], two / "all", lambda line: None)
    with pytest.raises(InputError, match="expected a separate folder"):
        merge_results([two / "a", two / "b"], two / "a" / "all", lambda line: None)
    (two / "empty").mkdir()
    with pytest.raises(InputError, match="contains no rows"):
        merge_folders(two, "a", "empty")
    unit = row_store.list_units(two / "a" / "sweep" / "rows")[0]
    unit.write_bytes(b"PAR1")
    with pytest.raises(InputError, match=unit.name):
        merge_folders(two, "a", "b")
