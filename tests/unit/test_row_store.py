"""Rows at scale: many units are read at once, packed or not, and give the same rows as one by one."""

import os
import shutil
import signal
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from springbench.harness.errors import InputError
from springbench.harness.experiments.archive import compaction as module
from springbench.harness.experiments.archive.compaction import compact_results
from springbench.harness.report.sql_query import run_query
from springbench.harness.results import parquet_rows, row_store, row_union

from tests.synthetic_run_rows import build_dummy_rows, write_dummy_runs

COUNT = 12


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    """A sweep with the given number of runs, of two schemas, one with a column of a user."""
    units = write_dummy_runs(tmp_path / "sweep", COUNT)
    older = pq.read_table(units[3]).drop_columns(["stationarity_audit", "formula_check"])
    pq.write_table(older, units[3])
    pq.write_table(pq.read_table(units[5]).append_column("colour", pa.array(["red", "blue"])), units[5])
    return tmp_path / "sweep"


def format_rows(table: pa.Table) -> list[str]:
    """The rows as text, because what is not a number equals nothing."""
    return list(map(repr, table.to_pylist()))


def one_by_one(units: list[Path]) -> pa.Table:
    return pa.concat_tables([parquet_rows.read_rows([unit]) for unit in units], promote_options="default")


def test_many_units_are_read_as_one_by_one_in_the_requested_order(sweep: Path):
    units = row_store.list_units(sweep / "rows")
    for requested in (units, units[::-1]):
        assert format_rows(parquet_rows.read_rows(requested)) == format_rows(one_by_one(requested))
        assert parquet_rows.read_rows(requested).schema.equals(one_by_one(requested).schema)
    heads = parquet_rows.read_first_rows(units, ["status", "positions_digest"], required_columns=("run_id",))
    assert heads == {
        u: {"status": "ok", "positions_digest": parquet_rows.read_rows([u])["positions_digest"][0].as_py()}
        for u in units
    }


def test_all_damaged_units_of_many_are_named(sweep: Path):
    units = row_store.list_units(sweep / "rows")
    os.truncate(units[1], 1000)
    parquet_rows.write_rows(units[4], [])
    pq.write_table(pa.table({"status": ["ok"], "seconds": ["soon"]}), units[7])
    with pytest.raises(InputError) as caught:
        parquet_rows.read_rows(units, required_columns=("status",))
    assert [mistake.file for mistake in caught.value.mistakes] == [units[k] for k in (1, 4, 7)]
    heads = parquet_rows.read_first_rows(units, ["status"], required_columns=("status",))
    assert [u for u, head in heads.items() if isinstance(head, str)] == [units[k] for k in (1, 4, 7)]
    with pytest.raises(InputError, match=units[1].name):
        run_query("SELECT count(*) FROM rows", sweep.parent)


QUERY = "SELECT * FROM rows ORDER BY run_id, frame"


def test_packed_rows_are_the_same_to_all_readers(sweep: Path):
    units = row_store.list_units(sweep / "rows")
    before, requested = format_rows(parquet_rows.read_rows(units)), repr(run_query(QUERY, sweep.parent).values)
    heads = parquet_rows.read_first_rows(units, ["source_fingerprint"])
    assert compact_results(sweep.parent, lambda line: None) == COUNT
    assert list((sweep / "rows").iterdir()) == []
    assert row_store.list_units(sweep / "rows") == units
    assert format_rows(parquet_rows.read_rows(units)) == before
    assert repr(run_query(QUERY, sweep.parent).values) == requested
    assert parquet_rows.read_first_rows(units, ["source_fingerprint"]) == heads
    first = parquet_rows.read_first_row(units[2])
    assert isinstance(first, dict)
    assert first["run_id"] == units[2].stem[-12:]
    turned = run_query("PIVOT rows ON solver USING count(*) GROUP BY status", sweep.parent)
    assert turned.columns == ["status", "hybrid", "lbfgs", "numba", "sparse", "xpbd"]


COLUMN_NAMES = "size=64/solver=a/scene=b/threads=9/machine=c/status=failed/frame=1/file=d"
PATTERNS = ("a[b]c", "a*c", "a?c", "a[!x]c", "a\\*c", "{a,b}", "~", "file:a", "100%41", "\udcff")
SHORT = ("run_id", "size", "solver", "scene", "status")


@pytest.mark.parametrize(
    "place", [COLUMN_NAMES, PATTERNS[0], *(pytest.param(name, marks=pytest.mark.long) for name in PATTERNS[1:])]
)
def test_no_name_of_a_folder_sets_a_column_or_leads_to_other_files(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    write_dummy_runs(tmp_path / "abc" / "sweep", 1, first_number=99)  # what patterns match
    monkeypatch.chdir(tmp_path)
    results = Path(place)
    units = write_dummy_runs(results / "sweep", 9, frames=1)
    short = [tuple(build_dummy_rows(int(unit.stem[-12:], 16))[0][name] for name in SHORT) for unit in units]

    def check() -> None:
        assert list(zip(*(parquet_rows.read_rows(units)[name].to_pylist() for name in SHORT), strict=True)) == short
        heads: Any = parquet_rows.read_first_rows(units, SHORT)
        assert [tuple(heads[unit][name] for name in SHORT) for unit in units] == short
        assert run_query(f"SELECT {', '.join(SHORT)} FROM rows ORDER BY ALL", results).values == sorted(short)

    check()
    assert compact_results(results, lambda line: None) == len(units)
    assert list((results / "sweep" / "rows").iterdir()) == []
    check()


def test_nothing_is_removed_where_the_packed_rows_differ_from_the_originals(
    sweep: Path, monkeypatch: pytest.MonkeyPatch
):
    before = {path: path.read_bytes() for path in sweep.rglob("*.parquet")}

    right = row_union.read_table

    def wrong(*arguments: Any, **named: Any) -> Any:
        table, number = right(*arguments, **named)
        return table.set_column(table.schema.get_field_index("size"), "size", pa.array([64] * len(table))), number

    monkeypatch.setattr(row_union, "read_table", wrong)
    monkeypatch.setattr(parquet_rows, "_MAX_SINGLE_READS", 0)
    with pytest.raises(InputError, match="nothing was removed"):
        compact_results(sweep, lambda line: None)
    assert {path: path.read_bytes() for path in sweep.rglob("*.parquet")} == before


def test_columns_that_duckdb_does_not_distinguish_are_read_by_their_exact_names(tmp_path: Path):
    units = write_dummy_runs(tmp_path / "sweep", 9, frames=1)
    for name in ("SIZE", "file_index"):
        for number, unit in enumerate(units):
            pq.write_table(pq.read_table(unit).append_column(name, pa.array([number])), unit)
        read = parquet_rows.read_rows(units)
        assert (read[name].to_pylist(), read["size"].to_pylist()) == (list(range(9)), [8 + k for k in range(9)])


def test_a_repeated_run_replaces_its_packed_rows_and_packing_continues(sweep: Path):
    compact_results(sweep, lambda line: None)
    unit = row_store.list_units(sweep / "rows")[0]
    number = int(unit.stem[-12:], 16)
    parquet_rows.write_rows(unit, [row | {"status": "failed"} for row in build_dummy_rows(number)])
    write_dummy_runs(sweep, 1, first_number=COUNT)
    for _ in range(2):
        found = run_query("SELECT status, count(*) FROM rows GROUP BY ALL ORDER BY ALL", sweep.parent)
        assert found.values == [("failed", 2), ("ok", 2 * COUNT)]
        compact_results(sweep, lambda line: None)
    assert list((sweep / "rows").iterdir()) == []


def test_damaged_and_recent_units_are_left_as_they_are(sweep: Path):
    units = row_store.list_units(sweep / "rows")
    os.truncate(units[1], 1000)
    said: list[str] = []
    assert compact_results(sweep, said.append, min_age_days=1.0) == 0
    assert compact_results(sweep, said.append) == COUNT - 1
    assert any("1 damaged file left" in line for line in said)
    assert [path.name for path in (sweep / "rows").iterdir()] == [units[1].name]
    with pytest.raises(InputError, match=units[1].name):
        parquet_rows.read_rows(row_store.list_units(sweep / "rows"))


def test_a_packed_file_that_is_damaged_is_named(sweep: Path):
    compact_results(sweep, lambda line: None)
    os.truncate(row_store.build_packed_path(sweep / "rows"), 1000)
    for look in (lambda: row_store.list_units(sweep / "rows"), lambda: run_query("SELECT 1", sweep.parent)):
        with pytest.raises(InputError, match=r"rows\.parquet"):
            look()


def killed_at(call: int, sweep: Path) -> None:
    """Pack, and die before the so-many-th of the calls that change what is on the disk."""
    count = 0

    def deadly(function: Callable[..., object]) -> Callable[..., object]:
        def count_call(*arguments: object, **named: object) -> object:
            nonlocal count
            count += 1
            if count > call:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **named)

        return count_call

    os.replace, Path.unlink, os.fsync = deadly(os.replace), deadly(Path.unlink), deadly(os.fsync)  # type: ignore[assignment]
    pq.ParquetWriter.write_table = deadly(pq.ParquetWriter.write_table)  # type: ignore[method-assign]
    module._BATCH_SIZE = 2
    compact_results(sweep, lambda line: None)


def test_packing_that_is_killed_at_any_time_loses_and_doubles_nothing_and_resumes(sweep: Path, tmp_path: Path):
    units = row_store.list_units(sweep / "rows")
    for unit in (*units[:2], *units[6:]):  # four are left, of three schemas
        unit.unlink()
    before, moments = format_rows(parquet_rows.read_rows(units[2:6])), 0
    while True:
        copy = tmp_path / str(moments) / "sweep"
        shutil.copytree(sweep, copy)
        process = get_context("fork").Process(target=killed_at, args=(moments, copy))
        process.start()
        process.join()
        left = row_store.list_units(copy / "rows")
        assert [unit.name for unit in left] == [unit.name for unit in units[2:6]]
        assert format_rows(parquet_rows.read_rows(left)) == before
        if process.exitcode == 0:  # it had done all before
            break
        assert process.exitcode == -signal.SIGKILL
        compact_results(copy, lambda line: None)
        assert {path.name for path in copy.iterdir()} == {"rows", "rows.parquet", ".lock"}
        assert list((copy / "rows").iterdir()) == []
        assert format_rows(parquet_rows.read_rows(left)) == before
        moments += 1
    assert moments == 2 + 3 + 1 + 4, "two batches, to sync, rename and sync, the partial file, and each unit"
