"""The options of a run are stated once: for sweeps, runs, rows and the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from harness.base.columns import SCHEMA
from harness.base.errors import InputError
from harness.cli import app
from harness.config import load
from harness.config.load import Sweep, load_any
from harness.config.options import OPTIONS
from harness.config.sweep import Include, RunSpec, Varied
from tests.unit.test_spec import CLOTH


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "cloth.yaml").write_text(CLOTH)
    return tmp_path


def test_the_command_line_gives_numbers_as_numbers(folder: Path) -> None:
    given = ["run", str(folder / "cloth.yaml"), "--frames", "1", "--tolerance", "1e-2", "--threads", "auto"]
    done = CliRunner().invoke(app, [*given, "--size", "4", "--here", "--results", str(folder / "results")])
    assert done.exit_code == 0, done.output


def test_each_option_that_a_sweep_varies_is_one_of_a_run_of_the_command_line_and_of_rows() -> None:
    assert set(OPTIONS) == set(Varied.model_fields), "what it is called for short, and its column"
    assert set(OPTIONS) <= set(RunSpec.model_fields)
    told = CliRunner().invoke(app, ["run", "--help"]).output
    assert {name for name in OPTIONS if f"--{name.replace('_', '-')} VALUE" in told} == set(OPTIONS)
    assert {option.column for option in OPTIONS.values()} - {""} <= set(SCHEMA.names)


def test_a_value_on_the_command_line_means_what_it_means_in_a_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}

    def loaded(path: Path, *, solvers: Any, sizes: Any, **options: Any) -> Sweep:
        asked.update(options)
        asked["runs"] = load_any(path, sizes=[4], **options).runs()
        raise InputError("enough")

    monkeypatch.setattr(load, "load_any", loaded)
    values = {"iterations": "7", "tolerance": "1e-3", "integrator": "bdf2", "time_step": "1/60", "frames": "0x3"}
    values |= {"first_guess": "inertial", "threads": "auto", "rounds": "1"}
    assert set(values) == set(OPTIONS)
    given = [part for name, text in values.items() for part in (f"--{name.replace('_', '-')}", text)]
    assert CliRunner().invoke(app, ["run", str(folder / "cloth.yaml"), *given]).exit_code == 2
    (run,) = asked.pop("runs")
    assert asked == {**values, "iterations": 7, "tolerance": 1e-3, "frames": 3, "rounds": 1}
    assert (run.iterations, run.tolerance, run.time_step, run.frames, run.rounds) == (7, 1e-3, 1 / 60, 3, 1)
    assert (run.integrator, run.first_guess, run.threads) == ("bdf2", "inertial", "auto")


@pytest.mark.parametrize(("key", "value"), [("tolerance", None), ("threads", 2), ("size", [4, 8])])
def test_an_entry_states_what_it_lists_and_nothing_else(key: str, value: object) -> None:
    entry = Include.model_validate({key: value})
    assert entry.stated(key) == (tuple(value) if isinstance(value, list) else (value,))
    assert not any(entry.stated(other) for other in Include.model_fields if other != key)
