"""The call sequence of a run as `harness/README.md` describes it: traced, call by call, for two frames."""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any, NamedTuple

import pytest
from springbench.harness.cli.main import app
from typer.testing import CliRunner

ROWS = (
    "cli",
    "experiments",
    "report",
    "config",
    "reference",
    "simulation",
    "recording",
    "scenes",
    "results",
    "execution schema",
    "console atomic_files",
    "errors",
    "solvers",
)
"""Rows of the page, the uppermost first."""

GIVEN = {
    (
        "springbench.harness.schema.config_document",
        "springbench.harness.scenes.vertex_selectors",
    ): "the models of what a document says check their fields",
    ("springbench.harness.schema.config_document", "springbench.harness.scenes.scene_spec"): "the same",
    ("springbench.harness.schema.config_document", "springbench.harness.scenes.effects.springs_effect"): "the same",
    (
        "springbench.solvers.contact.lagged_friction",
        "springbench.harness.reference.residual_audit",
    ): "a solver whose residuals are graded",
    (
        "springbench.solvers.contact.lagged_friction",
        "springbench.harness.simulation.solver_contract",
    ): "a solver whose inputs are compared after it",
}
"""The calls that lead up, each to what was given on the way down."""

STATIONS = (
    "springbench.harness.config.config_loader",
    "springbench.harness.config.expand_grid",
    "springbench.harness.experiments.sweep_plan",
    "springbench.harness.experiments.run_pipeline",
    "springbench.harness.simulation.timing_pass",
    "springbench.harness.simulation.time_loop",
    "springbench.harness.recording.rerun_recorder",
    "springbench.harness.simulation.instrumentation_pass",
    "springbench.harness.recording.recording_check",
    "springbench.harness.report.timing_table",
)

SCENE = """
mesh: {kind: grid}
mass: 1
time_step: 1/30
frames: 2
default_size: 4
effects: [{kind: springs, stretch: 300}, {kind: gravity}, {kind: pins, parts: [top_corners]}]
"""
SWEEP = "scenes: [scene.yaml]\nsolvers: [sparse]\noptions: {rounds: 1, max_iterations: 3, pictures: false}\n"


class Call(NamedTuple):
    """A call of one module's function by another module's, which may have gone through a library."""

    by: str
    of: str
    name: str


def row(module: str) -> int:
    _, package, name, *_ = [*module.split("."), ""]
    wanted = package if package == "solvers" else name
    return next(index for index, names in enumerate(ROWS) if wanted in names.split())


def ours(frame: FrameType | None) -> FrameType | None:
    """The nearest frame of the project's, from this one on upwards."""
    while frame and not frame.f_globals.get("__name__", "").startswith(
        ("springbench.harness.", "springbench.solvers.")
    ):
        frame = frame.f_back
    return frame


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> list[Call]:
    """All calls from one module to another, in their order, of a run whose libraries were loaded before."""
    folder, calls = tmp_path_factory.mktemp("walk"), list[Call]()
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "sweep.yaml").write_text(SWEEP)

    def run() -> None:
        arguments = ["run", str(folder / "sweep.yaml"), "--in-process", "--rerun", "--results", str(folder / "results")]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output

    def trace(frame: FrameType, event: str, argument: Any) -> None:
        if event != "call" or ours(frame) is not frame or frame.f_code.co_name == "<module>":
            return
        above = ours(frame.f_back)
        if above and (by := above.f_globals["__name__"]) != (of := frame.f_globals["__name__"]):
            calls.append(Call(by, of, frame.f_code.co_name))

    run()
    sys.setprofile(trace)
    try:
        run()
    finally:
        sys.setprofile(None)
    return calls


def test_calls_lead_down_the_rows_and_up_to_what_was_given_on_the_way(walk: list[Call]):
    assert {(call.by, call.of) for call in walk if row(call.of) < row(call.by)} == set(GIVEN)


def test_a_solve_takes_nothing_of_the_harness_along(walk: list[Call]):
    up = {
        (call.by, call.of)
        for call in walk
        if call.by.startswith("springbench.solvers.") and call.of.startswith("springbench.harness.")
    }
    assert up <= set(GIVEN)


def test_a_run_comes_by_its_stations_in_the_order_of_the_page(walk: list[Call]):
    assert [module for module in dict.fromkeys(call.of for call in walk) if module in STATIONS] == list(STATIONS)
    # A config is bound once to be checked, and a run once.
    assert [
        call.by for call in walk if (call.of, call.name) == ("springbench.harness.scenes.scene_builder", "build_scene")
    ] == [
        "springbench.harness.config.config_loader",
        "springbench.harness.experiments.run_pipeline",
    ]


def test_a_run_enters_few_modules_and_seldom_changes_them(walk: list[Call]):
    """Pages and tables apart, which are of all results."""
    before = [
        call
        for call in walk
        if "springbench.harness.report" not in call.by and "springbench.harness.report" not in call.of
    ]
    modules = {call.of for call in before}
    assert len(modules) <= 106, "106 when this was counted last"
    assert len(before) <= 1605, "1,602 when this was counted last, friction and the balances of energy among them"
