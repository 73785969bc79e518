"""Footer of tables: machines of the rows, and which numbers are comparable.

A machine is identified by the id of its kind, followed by the computer's own id where several computers are of one
kind.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa

COMPARISON_NOTE = (
    "compare times only on one machine; across machines compare ratios of such times, iterations, residuals and errors"
)
"""Statement on all rows, the last line of a footer."""

_MAX_LISTED = 8
"""Maximum number of machines with a line of their own."""

MACHINE_COLUMNS = ("cpu", "cores", "machine_bandwidth", "machine_flops_per_second", "machine_step_seconds")
"""Columns that describe a machine."""

FOOTER_COLUMNS = ("machine_id", "node_id", *MACHINE_COLUMNS)
"""All columns that the footer of a table needs."""

MachineKey = tuple[str | None, str | None]
"""The ids of a machine's kind and of the computer."""


def assign_machine_names(machine_keys: Iterable[MachineKey]) -> dict[MachineKey, str]:
    """Assign short names to machines; rows without a machine get none."""
    known = sorted({(machine, node) for machine, node in machine_keys if machine}, key=str)
    kinds = [machine for machine, _ in known]
    return {
        (machine, node): f"{machine:.6}{f'-{node:.4}' if node and kinds.count(machine) > 1 else ''}"
        for machine, node in known
    }


def build_machine_footer(table: pa.Table) -> list[str]:
    """Return the footer lines of a table of rows.

    They list its machines, and which numbers may be compared.
    """
    from springbench.harness.report.table_queries import query_table

    able = ", ".join(f'any_value("{name}")' for name in MACHINE_COLUMNS)
    found = query_table(
        f"select machine_id, node_id, {able} from rows_of where machine_id is not null group by all", table
    )
    known = assign_machine_names((machine, node) for machine, node, *_ in found)
    machine_lines = sorted(
        f"machine {known[machine, node]}: {_describe_machine(*about)}" for machine, node, *about in found
    )
    more = [f"and {len(machine_lines) - _MAX_LISTED} more machines"] if len(machine_lines) > _MAX_LISTED else []
    return [*machine_lines[:_MAX_LISTED], *more, COMPARISON_NOTE]


def _describe_machine(
    cpu: str | None, cores: int | None, bandwidth: float | None, flops: float | None, step: float | None
) -> str:
    """Describe a machine and its measured performance."""
    words = [cpu or "unknown processor", f"{cores} core{'s' if cores != 1 else ''}" if cores else ""]
    if bandwidth and flops and step:
        words += [
            f"by one thread {bandwidth / 1e9:.3g} GB/s, {flops / 1e9:.3g} GFLOP/s, a fixed step {1e3 * step:.3g} ms"
        ]
    return ", ".join(filter(None, words))
