"""Per-frame data of each run, in a script per run.

A script is loaded when its run is compared.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import pyarrow as pa
from springbench.harness.report.site import data_scripts
from springbench.harness.report.site.sweep_folders import SweepFolder
from springbench.harness.report.table_queries import query_table

_FRAME_COLUMNS = {
    "step_ms": "1e3 * median(seconds)",
    "least": "1e3 * min(seconds)",
    "lower": "1e3 * quantile_cont(seconds, 0.25)",
    "upper": "1e3 * quantile_cont(seconds, 0.75)",
    "num_iterations": "max(num_iterations)",
    "residual": "max(residual)",
    "max_strain": "max(max_strain)",
    "objective": "max(objective)",
    "energy_springs": "max(energy_springs)",
    "reference_distance": "max(reference_distance)",
}
"""Columns of a run's script, each as SQL over the rounds of a frame."""

_FLOAT32_MAX = "3e38"
"""Largest finite number in single precision, rounded down."""


def write_frame_scripts(folder: SweepFolder, table: pa.Table, data: Path, run_ids: Collection[str]) -> None:
    """Write the scripts of these runs.

    Args:
        folder: folder of the sweep's results.
        table: rows of the sweep.
        data: folder of the page's data of this sweep.
        run_ids: runs to write.
    """
    if not run_ids:
        return
    inner = ", ".join(f"{sql} as {name}" for name, sql in _FRAME_COLUMNS.items())
    # Single precision, whose shortest decimals to_json writes, is more accurate than the display. Values outside its
    # range are so large that only their order of magnitude matters.
    outer = ", ".join(
        f"'{name}': list(case when isfinite({name}) then least(greatest({name}, "
        f"-{_FLOAT32_MAX}), {_FLOAT32_MAX})::float end "
        "order by frame)"
        for name in _FRAME_COLUMNS
    )
    sql = f"""
        with steps as (
            select run_id, frame, {inner} from rows_of
            where phase = 'step' and frame is not null and run_id in (select unnest($requested)) group by run_id, frame
        ) select run_id, to_json({{'frame': list(frame order by frame), {outer}}}) from steps group by run_id"""
    for run, value in query_table(sql, table, {"requested": list(run_ids)}):
        data_scripts.write_json_script(data_scripts.script_path(data / "runs", run), f"{folder.slug}/runs/{run}", value)
