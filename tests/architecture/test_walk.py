"""The call sequence of a run as `harness/README.md` describes it: traced, call by call, for two frames."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from itertools import pairwise
from types import FrameType
from typing import Any, NamedTuple

import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.sweep_config import RunSpec, SolverSpec
from springbench.harness.scenes.scene_spec import SceneSpec
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

PASSED_CALLBACKS = {
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
    is_handover: bool


def row(module: str) -> int:
    _, package, name, *_ = [*module.split("."), ""]
    expected = package if package == "solvers" else name
    return next(index for index, names in enumerate(ROWS) if expected in names.split())


def carries_specification(value: object, depth: int = 3) -> bool:
    """Return whether a value is the specification of a run or a part of it, or contains one."""
    if isinstance(value, (RunSpec, SceneSpec, SolverSpec)):
        return True
    if not depth or isinstance(value, str):
        return False
    if isinstance(value, Mapping):
        return any(carries_specification(one, depth - 1) for one in value.values())
    if isinstance(value, (list, tuple, set, frozenset)):
        return any(carries_specification(one, depth - 1) for one in value)
    if is_dataclass(value):
        return any(carries_specification(getattr(value, one.name, None), depth - 1) for one in fields(value))
    return False


def is_handover(frame: FrameType) -> bool:
    """Return whether the arguments of a call carry the specification; a value that reads itself goes nowhere."""
    code = frame.f_code
    count = code.co_argcount + code.co_kwonlyargcount + bool(code.co_flags & 4) + bool(code.co_flags & 8)
    names = code.co_varnames[:count]
    return any(carries_specification(frame.f_locals[name]) for name in names if name != "self")


def find_project_frame(frame: FrameType | None) -> FrameType | None:
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
        if event != "call" or find_project_frame(frame) is not frame or frame.f_code.co_name == "<module>":
            return
        above = find_project_frame(frame.f_back)
        if above and (by := above.f_globals["__name__"]) != (of := frame.f_globals["__name__"]):
            sys.setprofile(None)
            calls.append(Call(by, of, frame.f_code.co_name, is_handover(frame)))
            sys.setprofile(trace)

    run()
    sys.setprofile(trace)
    try:
        run()
    finally:
        sys.setprofile(None)
    return calls


def test_calls_lead_down_the_rows_and_up_to_what_was_passed_down(walk: list[Call]):
    assert {(call.by, call.of) for call in walk if row(call.of) < row(call.by)} == set(PASSED_CALLBACKS)


def test_a_solve_calls_nothing_of_the_harness(walk: list[Call]):
    up = {
        (call.by, call.of)
        for call in walk
        if call.by.startswith("springbench.solvers.") and call.of.startswith("springbench.harness.")
    }
    assert up <= set(PASSED_CALLBACKS)


def test_a_run_passes_its_stations_in_the_order_of_the_page(walk: list[Call]):
    assert [module for module in dict.fromkeys(call.of for call in walk) if module in STATIONS] == list(STATIONS)
    # A config is bound once to be checked, once at its smallest size for the digits of its solvers, and a run once.
    assert [
        call.by for call in walk if (call.of, call.name) == ("springbench.harness.scenes.scene_builder", "build_scene")
    ] == [
        "springbench.harness.config.config_loader",
        "springbench.harness.experiments.sweep_runner",
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
    assert len(modules) <= 105, "105 when this was counted last, the accuracy of direct solves among them"
    assert len(before) <= 1680, "1,668 when this was counted last, the accuracy of direct solves among them"


def test_the_specification_of_a_run_passes_few_files_and_seldom_returns_to_one(walk: list[Call]):
    """From the config to the rows: which modules hand it to each other, one stay for each that it comes to."""
    handovers = [call for call in walk if call.is_handover and "springbench.harness.report" not in call.by + call.of]
    stays = [handovers[0].by]
    for module in (module for call in handovers for module in (call.by, call.of)):
        stays += [module] if module != stays[-1] else []
    climbs = [(below, above) for below, above in pairwise(stays) if row(above) < row(below)]
    assert len(stays) <= 40
    assert len(climbs) <= 8
