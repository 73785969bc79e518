"""SQL over the rows of all sweeps, accuracy configs and ablations (DuckDB on the Parquet files)."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import duckdb
import pyarrow as pa
from rich.table import Table

from harness.base import rows
from harness.base.errors import InputError

_TABLES: dict[str, pa.Schema] = {"rows": rows.SCHEMA, "accuracy": pa.schema([]), "ablation": pa.schema([])}
"""The tables by the names of their folders, with the columns that they have even where no row has them."""


@dataclass(frozen=True, slots=True)
class Answer:
    """Names of columns and the rows of values that a query gave."""

    columns: list[str]
    values: list[tuple[Any, ...]]

    def table(self) -> Table:
        """The answer as a table to print."""
        table = Table(*self.columns)
        for row in self.values:
            table.add_row(*("" if v is None else f"{v:.6g}" if isinstance(v, float) else str(v) for v in row))
        return table

    def write_csv(self, file: TextIO) -> None:
        """Write the answer as CSV with all digits."""
        writer = csv.writer(file)
        writer.writerow(self.columns)
        writer.writerows(self.values)


def answer(sql: str, results: Path) -> Answer:
    """What a query says of the tables `rows`, `accuracy` and `ablation`; it can read nothing else and write nothing.

    Raises InputError where there are no rows, or with DuckDB's message where the query is wrong.
    """
    files = {table: sorted(results.glob(f"*/{table}/*.parquet")) for table in _TABLES}
    if not any(files.values()):
        raise InputError(f"{results}: holds no rows; run a sweep first, or name its folder with --results")
    with duckdb.connect() as connection:
        for table, schema in _TABLES.items():
            if files[table] or len(schema):
                connection.register(table, rows.read(files[table], schema))
        connection.execute("SET enable_external_access = false; SET lock_configuration = true")
        try:
            found = connection.execute(sql)
        except duckdb.Error as error:
            raise InputError(f"query: {error}") from error
        if found is None or found.description is None:
            raise InputError("query: came without a statement; wanted one, such as SELECT count(*) FROM rows")
        return Answer([column[0] for column in found.description], found.fetchall())
