"""Hostile rows of runs: a value for a column each, of files from strangers.

LEFT_OUT must not fit their columns, and their files are named; ODD_COLUMNS must, and the page bears them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from springbench.harness.results.run_schema import RUN_SCHEMA

from tests import synthetic_site_rows

DEEP = "[" * 50_000
NO_SOURCE = {"authors": "A, B", "year": 2000, "title": "T", "doi": ""}

LEFT_OUT: dict[str, tuple[str, Any]] = {
    "a way out": ("run_id", "../../../../evil"),
    "an absolute way": ("run_id", "/evil"),
    "an id that is empty": ("run_id", ""),
    "an id of two dots": ("run_id", ".."),
    "an id of 1000 letters": ("run_id", "x" * 1000),
    "an id with NUL": ("run_id", "a\0b"),
    "an id with a line feed": ("run_id", "a\nb"),
    "an id of a script": ("run_id", "</script><script>alert(1)</script>"),
    "a scene that is a way": ("scene", "../../etc/passwd"),
    "a scene of two dots": ("scene", ".."),
    "a scene that is empty": ("scene", ""),
    "a scene of 5000 letters": ("scene", "x" * 5000),
    "a sweep that is a way": ("sweep", "/etc"),
    "a solver that is empty": ("solver", ""),
    "a solver of two lines": ("solver", "a\nb"),
    "a solver of 400 letters": ("solver", "x" * 400),
    "a solver that clears a screen": ("solver", "\x1b[2J"),
    "a solver that turns the writing": ("solver", "a\u202eb"),
    "a status that is empty": ("status", ""),
    "a status in capitals": ("status", "OK"),
    "a status of markup": ("status", "[bold]x[/nothing]"),
    "a status of 100 letters": ("status", "x" * 100),
    "a phase that is empty": ("phase", ""),
    "parameters that are none": ("parameters", ""),
    "parameters that are a list": ("parameters", "[1]"),
    "parameters that are null": ("parameters", "null"),
    "parameters that are cut": ("parameters", '{"a": '),
    "parameters of NaN": ("parameters", '{"a": NaN}'),
    "parameters of infinity": ("parameters", '{"a": -Infinity}'),
    "parameters that are deep": ("parameters", DEEP),
    "parameters of 200 kB": ("parameters", json.dumps({"a": "x" * 200_000})),
    "a reference that is a word": ("citation", '"Newton"'),
    "a reference that is empty": ("citation", "{}"),
    "a reference without authors": ("citation", json.dumps(NO_SOURCE | {"authors": ""})),
    "a reference of authors in a list": ("citation", json.dumps(NO_SOURCE | {"authors": ["A, B"]})),
    "a reference of a year in words": ("citation", json.dumps(NO_SOURCE | {"year": "MM"})),
    "a reference whose year is true": ("citation", json.dumps(NO_SOURCE | {"year": True})),
    "a reference of no doi": ("citation", json.dumps(NO_SOURCE | {"doi": None})),
    "a reference whose doi has a blank": ("citation", json.dumps(NO_SOURCE | {"doi": "10.1/x y"})),
    "a reference of two lines": ("citation", json.dumps(NO_SOURCE | {"title": "a\n@book{b"})),
    "a reference that is deep": ("citation", DEEP),
    "a negative size": ("size", -3),
    "a size of 2^63 - 1": ("size", 2**63 - 1),
    "negative vertices": ("vertices", -1),
    "a negative frame": ("frame", -1),
    "a frame of 2^63 - 1": ("frame", 2**63 - 1),
    "a negative round": ("round", -1),
    "a step of no time": ("time_step", 0.0),
    "a step of 1e-320 s": ("time_step", 1e-320),
    "a step of infinity": ("time_step", float("inf")),
    "a step of NaN": ("time_step", float("nan")),
    "a tolerance of NaN": ("residual_rtol", float("nan")),
    "a tolerance of infinity": ("residual_rtol", float("inf")),
    "a requested error of NaN": ("error_requested", float("nan")),
    "negative seconds": ("seconds", -1.0),
    "seconds of NaN": ("seconds", float("nan")),
    "seconds of infinity": ("seconds", float("inf")),
    "seconds of 1e300": ("seconds", 1e300),
    "negative iterations": ("num_iterations", -1),
    "a reason of 1 MB": ("reason", "x" * 1_000_000),
    "a processor of 1 MB": ("cpu", "x" * 1_000_000),
}

ODD_COLUMNS: dict[str, tuple[str, Any]] = {
    "a scene of a script": ("scene", "<script>alert(1)<&script>"),
    "a scene that is a link": ("scene", "javascript:alert(1)"),
    "a scene called __proto__": ("scene", "__proto__"),
    "a scene called constructor": ("scene", "constructor"),
    "a solver called __proto__": ("solver", "__proto__"),
    "a solver called toString": ("solver", "toString"),
    "a solver of markup": ("solver", "[red]x[/nothing]"),
    "a solver of a comma": ("solver", "sparse, omega 1"),
    "a solver in a folder": ("solver", "./my solver.py:Bad"),
    "a status of nobody": ("status", "constructor"),
    "a reason of markup": ("reason", "[bold]x[/nothing] </script>"),
    "a machine that is long": ("machine_id", "x" * 1000),
    "versions that are no JSON": ("versions", "{"),
    "a start that is no time": ("started_at", "yesterday"),
    "a commit of one letter": ("commit", "x"),
    "a strain of infinity": ("max_strain", float("inf")),
    "a strain of NaN": ("max_strain", float("nan")),
    "a residual of NaN": ("residual", float("nan")),
    "a residual of infinity": ("residual", float("inf")),
    "a residual below zero": ("residual", -1.0),
    "an initial residual of NaN": ("residual_initial", float("nan")),
    "an energy of infinity": ("energy_springs", float("inf")),
    "a distance of infinity": ("reference_distance", float("inf")),
    "a word for how it stopped": ("termination_reason", "bored"),
    "no time at all": ("seconds", 0.0),
    "no vertices": ("vertices", 0),
    "vertices that are not known": ("vertices", None),
    "parameters that are not known": ("parameters", None),
    "parameters of 400 digits": ("parameters", '{"a": ' + "9" * 400 + "}"),
    "parameters called __proto__": ("parameters", '{"__proto__": {"a": 1}}'),
    "a size that is not known": ("size", 0),
    "a step of 1e-12 s": ("time_step", 1e-12),
    "no commit": ("commit", None),
    "a digest of markup": ("positions_digest", "<b>"),
}


def rows_with(column: str, value: Any, number: int = 0) -> pa.Table:
    """The rows of two runs, of which the first has the value in all rows of the column; number: in the runs' ids."""
    first, second = ({"run_id": f"{2 * number + k:012x}"} for k in range(2))
    given_rows = [row | first | {column: value} for row in synthetic_site_rows.build_run_rows(0)]
    given_rows += [row | second for row in synthetic_site_rows.build_run_rows(5)]
    columns = {field.name: [row.get(field.name) for row in given_rows] for field in RUN_SCHEMA}
    return pa.table(columns, schema=RUN_SCHEMA)


def write_cases(folder: Path, cases: dict[str, tuple[str, Any]]) -> list[Path]:
    """A file of rows for each case, in a sweep's folder; returns them."""
    (folder / "rows").mkdir(parents=True)
    files = [folder / "rows" / f"hostile-{number:03}.parquet" for number in range(len(cases))]
    for number, (file, (column, value)) in enumerate(zip(files, cases.values(), strict=True)):
        pq.write_table(rows_with(column, value, number), file)
    return files
