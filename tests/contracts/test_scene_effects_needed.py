"""The scenes list the effects that their motions call for, and no others: `springbench ablate` says so of each."""

from __future__ import annotations

from pathlib import Path

import pytest
from springbench.harness.cli.commands.ablate import DEFAULT_ABLATION_SOLVER, DEFAULT_ABLATION_TOLERANCE
from springbench.harness.config.config_loader import load_config
from springbench.harness.experiments.ablation.ablation_unit import run_ablation
from springbench.harness.report.ablation_summary import describe_effect, read_ablation, select_kind

from tests.progress_displays import SilentDisplay

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
QUICK: dict[str, int | None] = {"heavy-bob": None, "tower": 8, "hanging-cloth": 12}
LONG: dict[str, int | None] = {
    "bending-strip": 21,
    "block-drop": 5,
    "block-slide": 5,
    "cloth-on-sphere": 9,
    "flag-in-wind": 16,
    "inflated-balloon": 4,
    "net-catches-ball": 9,
    "pulled-curtain": 9,
    "rope-bridge": 13,
    "spinning-skirt": 32,
}
TOUCH: dict[str, int | None] = {
    "fold-over-edge": 12,
    "garment": 9,
    "knot": 60,
    "net-on-block": 7,
    "poncho": 24,
    "ten-sheets": 4,
    "touching-curtain": 13,
    "touching-flag": 12,
    "twisted-cloth": 12,
}
"""Mesh sizes so small that an ablation takes seconds. What effects and time steps change shrinks with them alike."""
NEEDED_VERDICTS = ("this scene calls for it", "without it this is another scene", "the scene is impossible without it")


@pytest.mark.parametrize("name", [*QUICK, *(pytest.param(name, marks=pytest.mark.long) for name in LONG | TOUCH)])
def test_a_scene_has_the_effects_that_its_motion_calls_for_and_no_others(name: str, tmp_path: Path):
    size, folder = (QUICK | LONG | TOUCH)[name], CONFIGS / ("touch" if name in TOUCH else "scenes")
    options = {
        "solvers": [DEFAULT_ABLATION_SOLVER],
        "rtol": DEFAULT_ABLATION_TOLERANCE,
        "sizes": [size] if size else [],
        "rounds": 1,
        "threads": 1,
    }
    sweep = load_config(folder / f"{name}.yaml", **options)
    rows = read_ablation(
        run_ablation(sweep, tmp_path, SilentDisplay(), lambda line: None, with_pairs=False, isolated=False)
    )
    values = {row["name"]: describe_effect(row, rows) for row in select_kind(rows, "ablated")}
    assert {
        name: words for name, words in values.items() if not any(called in words for called in NEEDED_VERDICTS)
    } == {}
    # Scenes that all solvers take leave out contact of a mesh with itself, which few solvers know.
    assert {
        row["name"]: row["reason"] for row in select_kind(rows, "suggestion") if row["name"] != "self-contact"
    } == {}
