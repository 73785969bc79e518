"""What a device saves, derived from synthetic rows."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from springbench.harness.cli.main import app
from springbench.harness.report.device_speedup import (
    find_break_even,
    pair_fastest_runs,
    read_device_runs,
    summarise_runs,
)
from springbench.harness.results import parquet_rows
from springbench.solvers.iteration.device_interface import SIMULATOR_NAME
from typer.testing import CliRunner

from tests.unit.test_machine_comparison import table_of

ON = '{"device": "cuda", "spectral_radius": 0.999}'


def made(
    number: int, solver: str, vertices: int, seconds: float, *, on: bool = False, tolerance: float = 1e-3, **more: Any
) -> list[dict[str, Any]]:
    """The rows of a run of two steps; more: columns that differ."""
    row = {"run_id": f"{number:012x}", "sweep": "gpu", "scene": "cloth", "size": round(vertices**0.5), "phase": "step"}
    row |= {"solver": solver, "parameters": ON if on else "{}", "vertices": vertices, "residual_rtol": tolerance}
    row |= {
        "status": "ok",
        "termination_reason": "converged",
        "machine_id": "m",
        "node_id": "n",
        "num_iterations": 10,
        "round": 0,
    }
    row |= {
        "integrator": "implicit-euler",
        "time_step": 1 / 30,
        "is_minimiser": True,
        "started_at": "2026-01-01T00:00:00",
    }
    if on:
        row |= {"device": "a device", "kernel_seconds": 0.01}
    return [row | {"frame": frame, "seconds": seconds} | more for frame in (1, 2)]


def refused(number: int, reason: str) -> dict[str, Any]:
    row = made(number, "vbd", 0, 0.0, on=True)[0]
    gone = ("vertices", "seconds", "termination_reason", "frame", "device", "kernel_seconds")
    return row | dict.fromkeys(gone) | {"phase": "run", "status": "unsupported", "reason": reason}


MEASURED = [
    *(made(0, "vbd", 10_000, 0.02, on=True) + made(1, "hybrid", 10_000, 0.01) + made(2, "numba", 10_000, 0.5)),
    *(made(3, "vbd", 100_000, 0.05, on=True) + made(4, "hybrid", 100_000, 0.2)),
    *(made(5, "vbd", 1_000_000, 0.1, on=True) + made(6, "numba", 1_000_000, 3.0)),
    *made(7, "vbd", 4_000_000, 0.4, on=True),
    *(made(8, "vbd", 10_000, 1.0, on=True, tolerance=1e-4) + made(9, "hybrid", 10_000, 0.1, tolerance=1e-4)),
    *made(10, "numba", 10_000, 1e-9, termination_reason="max-iter"),  # it did not get there
    *made(11, "hybrid", 100_000, 1e-9, node_id="another"),  # where no device was
]


def describe_report(some: list[dict[str, Any]], config: str = "configs/gpu.yaml") -> str:
    return " ".join(summarise_runs(read_device_runs(table_of(some)), config)).replace("\u2009", ",")


def test_a_device_pays_from_where_it_is_faster_on_all_larger_meshes() -> None:
    said = describe_report(MEASURED)
    assert "cloth, to 0.001 of the residual at a step's start: a device pays from 100,000 vertices on" in said
    assert "vbd there is 4 times as fast as hybrid on the processor" in said
    assert "vbd there is 30 times as fast as numba on the processor at 1,000,000" in said
    assert "one side alone got there at 4,000,000 (device)" in said
    assert "to 0.0001 of the residual at a step's start: a device does not pay up to 10,000 vertices" in said
    assert "vbd there takes 10 times the time of hybrid" in said


@pytest.mark.parametrize(
    ("ratios", "first"),
    [([0.5, 2.0, 3.0], 1), ([2.0, 0.5, 3.0], 2), ([2.0, 3.0, 1.02], None), ([1.5], 0), ([], None)],
)
def test_a_mesh_in_between_that_is_slower_moves_the_size(ratios: list[float], first: int | None) -> None:
    sizes = [10**k for k in range(3, 6)]
    some = [
        row
        for k, (n, ratio) in enumerate(zip(sizes, ratios, strict=False))
        for row in made(2 * k, "vbd", n, 1.0, on=True) + made(2 * k + 1, "hybrid", n, ratio)
    ]
    mine = pair_fastest_runs(read_device_runs(table_of(some))).get(("cloth", 1e-3), [])
    found = find_break_even(mine)
    assert (found.vertices if found else None) == (None if first is None else sizes[first])


def test_without_a_device_nothing_is_claimed_and_the_command_is_named() -> None:
    said = describe_report([*made(0, "hybrid", 10_000, 0.1), refused(1, "vbd: there is no CUDA device")])
    assert "nothing is said of what one saves (vbd: there is no CUDA device)" in said
    assert "`.venv/bin/springbench run configs/gpu.yaml` fills this in" in said
    assert "times as fast" not in said
    assert describe_report(made(0, "hybrid", 10_000, 0.1)) == "", "of sweeps that ask for none nothing is said"


def test_times_of_the_simulator_are_no_devices() -> None:
    some = made(0, "vbd", 10_000, 0.1, on=True, device=SIMULATOR_NAME) + made(1, "hybrid", 10_000, 0.2)
    said = describe_report(some)
    assert f"nothing is said of what one saves ({SIMULATOR_NAME})" in said
    assert "pays" not in said
    assert pair_fastest_runs(read_device_runs(table_of(some))) == {}


def test_what_has_no_time_is_reported() -> None:
    some = [*made(0, "vbd", 100, 0.1, on=True), refused(1, "the device has no memory left")]
    said = describe_report(some)
    assert "1 of 2 runs on a device have no time: the device has no memory left." in said
    assert "at no size did both sides get there (the device alone), so nothing is compared" in said


@pytest.mark.parametrize("there", [True, False], ids=["measured", "no device"])
def test_the_report_draws_it_and_the_page_says_it(there: bool, tmp_path: Path) -> None:
    saved = MEASURED if there else [*made(0, "hybrid", 10_000, 0.1), refused(1, "vbd: there is no CUDA device")]
    folder = tmp_path / "r" / "gpu" / "rows"
    folder.mkdir(parents=True)
    for unit in {row["run_id"] for row in saved}:
        parquet_rows.write_rows(folder / f"{unit}.parquet", [row for row in saved if row["run_id"] == unit])
    done = CliRunner().invoke(app, ["report", str(tmp_path / "r"), "--no-viewer"])
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    picture = tmp_path / "r" / "gpu" / "pictures" / "devices.png"
    assert picture.exists() is there
    wanted = "a device pays from 100" if there else "nothing is said of what one saves"
    assert wanted in said
    assert wanted in (tmp_path / "r" / "site" / "data" / "index.js").read_text()
    if there:
        with Image.open(picture) as image:
            assert np.asarray(image.convert("L")).min() < 100, "something is drawn"
