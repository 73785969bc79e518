"""`springbench ablate --all-solvers`: what an iteration takes with an effect, by every solver."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.console import get_error_console, print_message
from springbench.harness.errors import InputError
from springbench.harness.execution.progress_display import create_display
from springbench.harness.experiments.ablation import iteration_overhead
from springbench.harness.experiments.ablation.iteration_overhead import list_measured_effects, select_effects
from springbench.harness.experiments.ablation.overhead_unit import measure_all_overheads
from springbench.harness.report.ablation_summary import build_overhead_table, read_ablation
from springbench.harness.scenes.scene_builder import Scene
from springbench.harness.simulation.time_loop import simulate_scene
from springbench.solvers.model.integrators import INTEGRATORS
from typer.testing import CliRunner

CLOTH = """
mesh: {kind: grid}
mass: 0.3
time_step: 1/30
frames: 2
default_size: 5
effects:
  - {kind: springs, stretch: 300, shear: 60}
  - {kind: gravity}
  - {kind: pins, parts: [top_corners]}
  - {kind: bending, stiffness: 1.0e-3}
  - {kind: air-drag, coefficient: 0}
"""
"""Drag of no coefficient has no energy at all."""


@pytest.fixture
def cloth(tmp_path: Path) -> Path:
    path = tmp_path / "cloth.yaml"
    path.write_text(CLOTH)
    return path


def test_every_solver_has_an_overhead_of_each_effect_or_states_why_not(cloth: Path, tmp_path: Path):
    sweep = load_config(cloth, solvers=["newton", "dense"], rounds=4, rtol=1e-6, threads=1)
    paths = measure_all_overheads(sweep, tmp_path, create_display(get_error_console()), print_message, isolated=False)
    values = {(row["name"], row["solver"]): row for path in paths for row in read_ablation(path)}
    assert set(values) == {(e, s) for e in ("bending", "air-drag", "all") for s in ("newton", "dense")}
    for (effect, solver), row in values.items():
        if solver == "dense" and effect != "air-drag":
            assert row["status"] == "unsupported"
            assert row["overhead_ratio"] is None
            assert "Quadratic" in row["reason"] or "Bending" in row["reason"]
            continue
        assert row["overhead_ratio_low"] <= row["overhead_ratio"] <= row["overhead_ratio_high"]
        assert (
            row["overhead_ratio_bound"] == 1.0 if effect == "air-drag" else 1.0 < row["overhead_ratio_bound"] < 2.0
        )  # some kilobytes
        assert 3 <= row["rounds"] <= 4
        assert row["seconds"] > 0.0
    table = build_overhead_table(list(values.values()))
    assert [str(column.header) for column in table.columns] == ["effect", "newton", "dense"]
    assert next(iter(table.columns[2].cells)) == "unsupported"


def test_overheads_are_those_of_the_integrator_and_the_initial_guess_of_the_run(
    cloth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    seen: set[tuple[str, str]] = set()

    def simulate(scene: Scene, *rest: Any, initial_guess: str, frames: int) -> Iterator[Any]:
        name = next(name for name, one in INTEGRATORS.items() if one is scene.integrator)
        seen.add((name, initial_guess))
        return simulate_scene(scene, *rest, initial_guess=initial_guess, frames=frames)

    monkeypatch.setattr(iteration_overhead, "simulate_scene", simulate)
    options: dict[str, Any] = {"integrator": "midpoint", "initial_guess": "inertial"}
    sweep = load_config(cloth, solvers=["newton"], rounds=1, rtol=1e-6, threads=1, **options)
    (path,) = measure_all_overheads(sweep, tmp_path, create_display(get_error_console()), print_message, isolated=False)
    assert {row["status"] for row in read_ablation(path)} == {"ok"}
    assert seen == {("midpoint", "inertial")}


@pytest.mark.parametrize("also", [["--with-pairs"], ["--solver", "newton"]], ids=" ".join)
def test_options_of_one_solver_are_refused(cloth: Path, also: list[str]):
    refused = CliRunner().invoke(app, ["ablate", str(cloth), "--all-solvers", *also])
    assert refused.exit_code == 2
    assert "cannot be combined with --solver or --with-pairs" in refused.output


def test_a_scene_of_plain_effects_alone_has_no_overhead(cloth: Path):
    with pytest.raises(
        InputError, match=r"effects: got .*springs.*part of the baseline; add one .*: air-drag, .*bending"
    ):
        list_measured_effects(select_effects(load_scene(cloth)))
