# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyarrow's stubs do not know the columns of a schema.
"""The numbers in the cells of a recording's chunks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray


def cell(batch: pa.RecordBatch, name: str, row: int = 0) -> NDArray[Any]:
    """All numbers of one row of a component, flat."""
    values = scalar(batch, name, row).values
    while pa.types.is_nested(values.type):
        values = values.flatten()
    return values.to_numpy()


def counted(batch: pa.RecordBatch, timeline: str) -> NDArray[Any]:
    """The frames or iterations, or the times [s]."""
    found = column(batch, timeline)
    counts: NDArray[np.int64] = found.cast(pa.int64()).to_numpy()
    return counts / 1e9 if pa.types.is_duration(found.type) else counts


def column(batch: pa.RecordBatch, name: str) -> Any:
    """A column; pyarrow's stubs know no kind of array that is told by its schema alone."""
    return cast(Any, batch[name])


def scalar(batch: pa.RecordBatch, name: str, row: int) -> Any:
    """One row of a column."""
    return column(batch, name)[row]


def replaced(batch: pa.RecordBatch, name: str, rows: Sequence[NDArray[Any]]) -> pa.RecordBatch:
    """The batch with other numbers in a component, row by row."""
    at = batch.schema.get_field_index(name)
    return batch.set_column(at, batch.schema.field(at), pa.array(rows, batch.schema.field(at).type))
