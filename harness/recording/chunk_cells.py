# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs do not state the column types of a schema.
"""Access to the numbers in the cells of a recording's chunks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray


def read_cell(batch: pa.RecordBatch, name: str, row: int = 0) -> NDArray[Any]:
    """Return all numbers of one row of a component as a flat array.

    Args:
      batch: chunk of a recording.
      name: name of the component.
      row: index of the row.
    """
    values = get_scalar(batch, name, row).values
    while pa.types.is_nested(values.type):
        values = values.flatten()
    return values.to_numpy()


def read_timeline(batch: pa.RecordBatch, timeline: str) -> NDArray[Any]:
    """Return a timeline of a batch: frames, iterations, or times [s]."""
    found = get_column(batch, timeline)
    counts: NDArray[np.int64] = found.cast(pa.int64()).to_numpy()
    return counts / 1e9 if pa.types.is_duration(found.type) else counts


def get_column(batch: pa.RecordBatch, name: str) -> Any:
    """Return a column, untyped.

    pyarrow's stubs do not type arrays that depend on the schema.
    """
    return cast(Any, batch[name])


def get_scalar(batch: pa.RecordBatch, name: str, row: int) -> Any:
    """Return one row of a column."""
    return get_column(batch, name)[row]


def replace_cells(batch: pa.RecordBatch, name: str, rows: Sequence[NDArray[Any]]) -> pa.RecordBatch:
    """Return the batch with the numbers of a component replaced row by row.

    Args:
      batch: chunk of a recording.
      name: name of the component.
      rows: new numbers of each row, flat.
    """
    at = batch.schema.get_field_index(name)
    return batch.set_column(at, batch.schema.field(at), pa.array(rows, batch.schema.field(at).type))
