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
from springbench.solvers.iteration.device_interface import SIMULATOR_NAME
from typer.testing import CliRunner

from tests.bench.device import compare_sides
from tests.synthetic_device_rows import DEVICE_ROWS, build_device_rows, write_device_results
from tests.unit.test_machine_comparison import table_of


def build_refused_row(number: int, reason: str) -> dict[str, Any]:
    row = build_device_rows(number, "vbd", 0, 0.0, on=True)[0]
    gone = ("vertices", "seconds", "termination_reason", "frame", "device", "kernel_seconds")
    return row | dict.fromkeys(gone) | {"phase": "run", "status": "unsupported", "reason": reason}


def describe_report(some: list[dict[str, Any]], config: str = "configs/gpu.yaml") -> str:
    return " ".join(summarise_runs(read_device_runs(table_of(some)), config)).replace("\u2009", ",")


def test_a_device_pays_from_where_it_is_faster_on_all_larger_meshes() -> None:
    said = describe_report(DEVICE_ROWS)
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
        for row in build_device_rows(2 * k, "vbd", n, 1.0, on=True) + build_device_rows(2 * k + 1, "hybrid", n, ratio)
    ]
    mine = pair_fastest_runs(read_device_runs(table_of(some))).get(("cloth", 1e-3), [])
    found = find_break_even(mine)
    assert (found.vertices if found else None) == (None if first is None else sizes[first])


def test_without_a_device_nothing_is_claimed_and_the_command_is_named() -> None:
    said = describe_report(
        [*build_device_rows(0, "hybrid", 10_000, 0.1), build_refused_row(1, "vbd: there is no CUDA device")]
    )
    assert "nothing is said of what one saves (vbd: there is no CUDA device)" in said
    assert "`.venv/bin/springbench run configs/gpu.yaml` fills this in" in said
    assert "times as fast" not in said
    plain = build_device_rows(0, "hybrid", 10_000, 0.1)
    assert describe_report(plain) == "", "of sweeps that ask for none nothing is said"


def test_times_of_the_simulator_are_no_devices() -> None:
    some = build_device_rows(0, "vbd", 10_000, 0.1, on=True, device=SIMULATOR_NAME)
    some += build_device_rows(1, "hybrid", 10_000, 0.2)
    said = describe_report(some)
    assert f"nothing is said of what one saves ({SIMULATOR_NAME})" in said
    assert "pays" not in said
    assert pair_fastest_runs(read_device_runs(table_of(some))) == {}


def test_what_has_no_time_is_reported() -> None:
    some = [*build_device_rows(0, "vbd", 100, 0.1, on=True), build_refused_row(1, "the device has no memory left")]
    said = describe_report(some)
    assert "1 of 2 runs on a device have no time: the device has no memory left." in said
    assert "at no size did both sides get there (the device alone), so nothing is compared" in said


@pytest.mark.parametrize("there", [True, False], ids=["measured", "no device"])
def test_the_report_draws_the_ratio_and_the_page_states_it(there: bool, tmp_path: Path) -> None:
    failed = [*build_device_rows(0, "hybrid", 10_000, 0.1), build_refused_row(1, "vbd: there is no CUDA device")]
    saved = DEVICE_ROWS if there else failed
    write_device_results(tmp_path / "r" / "gpu", saved)
    done = CliRunner().invoke(app, ["report", str(tmp_path / "r"), "--no-viewer"])
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    picture = tmp_path / "r" / "gpu" / "pictures" / "devices.png"
    assert picture.exists() is there
    expected = "a device pays from 100" if there else "nothing is said of what one saves"
    assert expected in said
    assert expected in (tmp_path / "r" / "site" / "data" / "index.js").read_text()
    if there:
        with Image.open(picture) as image:
            assert np.asarray(image.convert("L")).min() < 100, "something is drawn"


def test_sides_are_compared_by_the_fastest_method_that_reached_the_tolerance() -> None:
    def time_row(method: str, device: str | None, seconds: float, reason: str = "converged") -> dict[str, Any]:
        shared = {"kind": "time", "scene": "cloth", "size": 8, "rtol": 0.1}
        return shared | {"method": method, "device": device, "seconds": seconds, "reason": reason}

    rows = [
        time_row("vbd, float32", "H, 132 multiprocessors", 4.0),
        time_row("vbd, float64", "H, 132 multiprocessors", 8.0),
        time_row("newton-cg, float32", "H, 132 multiprocessors", 1.0, "max-iter"),
        time_row("hybrid", None, 2.0),
    ]
    (found,) = compare_sides(rows)
    assert (found["device"], found["time_ratio"]) == ("H", 2.0)
    assert (found["device_method"], found["processor_method"]) == ("vbd, float32", "hybrid")
    assert compare_sides(rows[:3]) == []
