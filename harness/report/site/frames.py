"""Per-frame data of each run, in a script per run.

A script is loaded when its run is opened or compared.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pyarrow as pa

from harness.report.site import script
from harness.report.site.folders import Folder
from harness.report.sql import answer

_FIGURES = {
    "ms": "1e3 * median(seconds)",
    "least": "1e3 * min(seconds)",
    "lower": "1e3 * quantile_cont(seconds, 0.25)",
    "upper": "1e3 * quantile_cont(seconds, 0.75)",
    "iterations": "max(iterations)",
    "residual": "max(residual)",
    "strain": "max(largest_strain)",
    "objective": "max(objective)",
    "springs": "max(energy_springs)",
    "distance": "max(distance)",
}
"""Columns of a run's script, each as SQL over the rounds of a frame."""

_MOST = "3e38"
"""Largest finite number in single precision, rounded down."""


def write(folder: Folder, table: pa.Table, data: Path, wanted: Collection[str]) -> None:
    """Write the scripts of these runs.

    Args:
        folder: folder of the sweep's results.
        table: rows of the sweep.
        data: folder of the page's data of this sweep.
        wanted: runs to write.
    """
    if not wanted:
        return
    inner = ", ".join(f"{sql} as {name}" for name, sql in _FIGURES.items())
    # Single precision, whose shortest decimals to_json writes, is more accurate than the display. Values outside its
    # range are so large that only their order of magnitude matters.
    outer = ", ".join(
        f"'{name}': list(case when isfinite({name}) then least(greatest({name}, -{_MOST}), {_MOST})::float end "
        "order by frame)"
        for name in _FIGURES
    )
    sql = f"""
        with steps as (
            select run_id, frame, {inner} from rows_of
            where phase = 'step' and frame is not null and run_id in (select unnest($wanted)) group by run_id, frame
        ) select run_id, to_json({{'frame': list(frame order by frame), {outer}}}) from steps group by run_id"""
    for run, value in answer(sql, table, {"wanted": list(wanted)}):
        script.write_text(script.below(data / "runs", run), f"{folder.slug}/runs/{run}", value)
