"""The options of a run are stated once: for sweeps, runs, rows and the command line."""

from __future__ import annotations

from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.cli.commands.ablate import ablate
from springbench.harness.cli.main import app, run
from springbench.harness.config import config_loader
from springbench.harness.config.config_loader import SweepPlan, load_config
from springbench.harness.config.run_options import RUN_OPTIONS
from springbench.harness.config.sweep_config import IncludeEntry, RunSpec, VariedOptions
from springbench.harness.errors import InputError
from springbench.harness.results import parquet_rows
from springbench.harness.results.run_schema import RUN_SCHEMA
from typer.testing import CliRunner

from tests.unit.test_sweep_expansion import CLOTH


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "cloth.yaml").write_text(CLOTH)
    return tmp_path


def test_the_command_line_gives_numbers_as_numbers(folder: Path) -> None:
    given = ["run", str(folder / "cloth.yaml"), "--frames", "1", "--rtol", "1e-2", "--threads", "auto"]
    done = CliRunner().invoke(app, [*given, "--size", "4", "--in-process", "--results", str(folder / "results")])
    assert done.exit_code == 0, done.output


def test_each_option_that_a_sweep_varies_is_one_of_a_run_of_the_command_line_and_of_rows() -> None:
    assert set(RUN_OPTIONS) == set(VariedOptions.model_fields), "what it is called for short, and its column"
    assert set(RUN_OPTIONS) <= set(RunSpec.model_fields)
    result = CliRunner().invoke(app, ["run", "--help"]).output
    assert {name for name in RUN_OPTIONS if f"--{name.replace('_', '-')} VALUE" in result} == set(RUN_OPTIONS)
    assert {option.column for option in RUN_OPTIONS.values()} - {""} <= set(RUN_SCHEMA.names)


def test_a_value_on_the_command_line_means_what_it_means_in_a_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings: dict[str, Any] = {}

    def load_stub(path: Path, *, solvers: Any, sizes: Any, **options: Any) -> SweepPlan:
        settings.update(options)
        settings["runs"] = load_config(path, sizes=[4], **options).list_runs()
        raise InputError("enough")

    monkeypatch.setattr(config_loader, "load_config", load_stub)
    values = {"max_iterations": "7", "rtol": "1e-3", "integrator": "bdf2", "time_step": "1/60", "frames": "0x3"}
    values |= {"initial_guess": "inertial", "threads": "auto", "rounds": "1"}
    assert set(values) == set(RUN_OPTIONS) - {"error_target"}, "which would choose most of them"
    given = [part for name, text in values.items() for part in (f"--{name.replace('_', '-')}", text)]
    assert CliRunner().invoke(app, ["run", str(folder / "cloth.yaml"), *given]).exit_code == 2
    (run,) = settings.pop("runs")
    assert settings == {**values, "max_iterations": 7, "rtol": 1e-3, "frames": 3, "rounds": 1}
    assert (run.max_iterations, run.rtol, run.time_step, run.frames, run.rounds) == (7, 1e-3, 1 / 60, 3, 1)
    assert (run.integrator, run.initial_guess, run.threads) == ("bdf2", "inertial", "auto")


@pytest.mark.parametrize(("key", "value"), [("rtol", None), ("threads", 2), ("size", [4, 8])])
def test_an_entry_states_what_it_lists_and_nothing_else(key: str, value: object) -> None:
    entry = IncludeEntry.model_validate({key: value})
    assert entry.get_values(key) == (tuple(value) if isinstance(value, list) else (value,))
    assert not any(entry.get_values(other) for other in IncludeEntry.model_fields if other != key)


SWEEP = "scenes: [cloth.yaml]\nsizes: [4]\nsolvers: [{}]\noptions: {{frames: 4, threads: 1, rounds: 1, {}}}\n"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("error_target: 1e-2, integrator: bdf2", "options.integrator: is chosen by the `error_target`"),
        ("error_target: [1e-2, 1e-3], rtol: 1e-3", "options.rtol: is chosen by the `error_target`"),
        ("error_target: 2.0", "options.error_target"),
        ("error_target: 1e-2, verify: true", "options.verify: needs a number or null as `rtol`"),
        ("rtol: auto, verify: true", "options.verify: needs a number or null as `rtol`"),
        ("rtol: automatic", "options.rtol"),
    ],
)
def test_an_option_that_an_error_or_auto_determines_is_refused(folder: Path, options: str, said: str) -> None:
    (folder / "sweep.yaml").write_text(SWEEP.format("newton", options))
    with pytest.raises(InputError) as refused:
        load_config(folder / "sweep.yaml")
    assert said in str(refused.value)


def test_a_requested_error_next_to_stated_steps_is_one_run_and_has_no_part_in_the_others_names(folder: Path) -> None:
    (folder / "sweep.yaml").write_text(
        SWEEP.format("newton", "error_target: [null, 1e-2], integrator: [bdf2, midpoint]")
    )
    (folder / "plain.yaml").write_text(SWEEP.format("newton", "integrator: [bdf2, midpoint]"))
    runs, plain = load_config(folder / "sweep.yaml").list_runs(), load_config(folder / "plain.yaml").list_runs()
    assert [run.error_target for run in runs] == [None, 0.01, None]
    assert [run.build_identity() for run in runs if run.error_target is None] == [run.build_identity() for run in plain]


def test_a_sweep_meets_an_error_and_its_rows_state_the_cost(folder: Path) -> None:
    (folder / "cloth.yaml").write_text(f"{CLOTH}  - {{kind: gravity}}\n  - {{kind: pins, parts: [top_corners]}}\n")
    (folder / "sweep.yaml").write_text(SWEEP.format("dormand-prince-8, xpbd", "error_target: 1e-3, pictures: false"))
    done = CliRunner().invoke(
        app, ["run", str(folder / "sweep.yaml"), "--in-process", "--results", str(folder / "results")]
    )
    assert done.exit_code == 1, done.output
    assert "xpbd: has no error estimate" in done.output
    (file,) = (folder / "results" / "sweep" / "rows").glob("*-dormand-prince-8-*.parquet")
    found = [row for row in parquet_rows.read_rows([file]).to_pylist() if row["phase"] == "step"]
    assert [row["frame"] for row in found] == [1, 2, 3, 4]
    assert all(0.0 < row["error_estimated"] <= row["error_requested"] == 1e-3 for row in found)
    assert all(
        row["num_accepted_steps"] > 0 and row["seconds"] > 0 and row["integrator"] == "substepping" for row in found
    )
    assert found[-1]["recording_digest"], "the recording was read back"


def test_speed_compares_steps_as_they_are_stated(folder: Path) -> None:
    for options in ("error_target: 1e-2", "rtol: auto"):
        (folder / "sweep.yaml").write_text(SWEEP.format("newton", options))
        done = CliRunner().invoke(app, ["roofline", str(folder / "sweep.yaml"), "--results", str(folder / "results")])
        assert done.exit_code == 2, done.output


@pytest.mark.parametrize("command", [run, ablate])
def test_no_option_of_runs_has_the_name_of_a_parameter_of_its_command(command: Callable[..., None]):
    """Such an option would take the value of the parameter, which is then never given."""
    assert not set(RUN_OPTIONS) & set(signature(command).parameters)
