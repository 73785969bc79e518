# pyright: reportUnknownMemberType=false
# PyArrow's stubs do not type most keywords.
"""Reader of tables with named columns: CSV with a header line, or Parquet."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from springbench.harness.errors import InputError, InputMistake, format_allowed_names
from springbench.harness.scenes.mesh.spring_network import check_mesh_file

MAX_TABLE_BYTES = 2**28
"""Maximum size of a table; larger ones are rejected before reading."""
_WORDS = {"true": 1.0, "yes": 1.0, "false": 0.0, "no": 0.0}
"""Words that stand for 1 and 0."""
_MISSING = frozenset({"", "na", "nan", "null", "none"})
"""Contents of a cell, in lower case, that give no value."""


@dataclass(frozen=True, slots=True)
class DataTable:
    """Columns of a table by name.

    Attributes:
        path: the file, for messages.
        columns: text of each cell, or numbers with NaN for missing ones, each (rows,).
        row_lines: line at which each row starts, empty for a file without lines.
    """

    path: Path
    columns: dict[str, list[str] | NDArray[np.float64]]
    row_lines: Sequence[int] = ()

    @property
    def num_rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values()), ()))

    def require_column(self, name: str) -> NDArray[np.float64]:
        """Return a column as numbers, (rows,), with NaN for empty cells.

        Raises:
            InputError: if it is missing, or a cell is neither empty nor a finite number.
        """
        if name not in self.columns:
            known = format_allowed_names(name, self.columns)
            hint = "; separate the columns by commas" if len(self.columns) == 1 else ""
            raise InputError(InputMistake(f"has no column {name!r}; its columns are {known}{hint}", self.path))
        return self._convert_column(name, self.columns[name])

    def find_numeric_columns(self) -> dict[str, NDArray[np.float64]]:
        """Return all columns whose cells are numbers or empty."""
        found = dict[str, NDArray[np.float64]]()
        for name in self.columns:
            try:
                found[name] = self.require_column(name)
            except InputError:
                continue
        return found

    def make_error(self, problem: str, row: int) -> InputError:
        """Return an error at a row.

        Args:
            problem: description of the mistake, with its remedy.
            row: number of the row, from 0; the message states its line in the file if the file has lines.
        """
        if self.row_lines:
            return InputError(InputMistake(problem, self.path, self.row_lines[row]))
        return InputError(InputMistake(f"row {row} (from 0): {problem}", self.path))

    def _convert_column(self, name: str, cells: list[str] | NDArray[np.float64]) -> NDArray[np.float64]:
        if isinstance(cells, np.ndarray):
            if np.isinf(cells).any():
                raise self.make_error(f"{name} is infinite; expected a finite number", int(np.isinf(cells).argmax()))
            return cells
        out = np.empty(len(cells))
        for row, cell in enumerate(cells):
            text = cell.strip().lower()
            try:
                out[row] = np.nan if text in _MISSING else float(_WORDS.get(text, text))
            except ValueError:
                out[row] = np.inf
            if np.isinf(out[row]):
                raise self.make_error(f"{name} is {cell[:40]!r}; expected a finite number or an empty cell", row)
        return out


def read_data_table(path: Path) -> DataTable:
    """Read a table from a Parquet file or a CSV file with a header line.

    Raises:
        InputError: if the file is missing, too large, malformed or has no rows.
    """
    check_mesh_file(path, max_bytes=MAX_TABLE_BYTES)
    table = _read_parquet(path) if path.suffix.lower() in (".parquet", ".pq") else _read_csv(path)
    if not table.num_rows:
        raise InputError(InputMistake("has no rows below its header", path))
    return table


def _read_csv(path: Path) -> DataTable:
    rows, lines = list[list[str]](), [1]
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            for row in reader:
                rows.append(row)
                lines.append(reader.line_num + 1)  # quoted cells may contain line breaks
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(InputMistake(f"is no table in UTF-8 text with commas ({error})", path)) from None
    while rows and not any(rows[-1]):
        rows.pop()
    header = [name.strip() for name in rows[0]] if rows else []
    if len(set(header)) < len(header) or not all(header):
        raise InputError(InputMistake("should name each column once", path, 1))
    for line, row in zip(lines[1:], rows[1:], strict=False):
        if len(row) != len(header):
            raise InputError(InputMistake(f"has {len(row)} cells for {len(header)} columns", path, line))
    return DataTable(path, {name: [row[k] for row in rows[1:]] for k, name in enumerate(header)}, lines[1:])


def _read_parquet(path: Path) -> DataTable:
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.read_table(path)
    except (pyarrow.ArrowException, OSError) as error:
        raise InputError(InputMistake(f"cannot be read as Parquet ({str(error)[:200]})", path)) from None
    columns = dict[str, list[str] | NDArray[np.float64]]()
    for name, column in zip(table.column_names, table.columns, strict=True):
        kind = column.type
        if pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind) or pyarrow.types.is_boolean(kind):
            columns[name] = np.array([np.nan if x is None else float(x) for x in column.to_pylist()], np.float64)
        else:
            columns[name] = ["" if x is None else str(x) for x in column.to_pylist()]
    return DataTable(path, columns)
