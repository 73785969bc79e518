"""Ablation: what is compared, what its numbers mean, and the words that follow from them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from springbench.harness.cli.commands.ablate import DEFAULT_ABLATION_SOLVER
from springbench.harness.cli.main import app
from springbench.harness.config.config_loader import load_config, load_scene
from springbench.harness.experiments.ablation.ablation_unit import run_ablation
from springbench.harness.experiments.ablation.interleaved_variants import VariantRun, compute_cost
from springbench.harness.experiments.ablation.scene_variants import SceneVariant, build_variants
from springbench.harness.report.ablation_summary import describe_effect, read_ablation, summarise_ablation
from springbench.harness.report.plot_style import PAGE_WIDTH
from springbench.harness.results.folder_ownership import claim_folder
from springbench.harness.results.run_schema import RUN_COLUMNS as RUN_COLUMNS
from typer.testing import CliRunner

from tests.progress_displays import SilentDisplay

ROOT = Path(__file__).resolve().parents[2]
CLOTH = """
mesh: {kind: grid}
mass: 0.3
time_step: 1/30
frames: 8
default_size: 5
effects:
  - {kind: springs, stretch: 300, shear: 60}
  - {kind: gravity}
  - {kind: bending, stiffness: 1.0e-3}
  - {kind: air-drag, coefficient: 0}
  - {kind: pins, parts: [top_corners]}
"""
SMALL_CLOTH = """
mesh: {kind: grid}
mass: 0.3
time_step: 1/30
frames: 8
default_size: 5
effects: [{kind: springs, stretch: 300, shear: 60}, {kind: gravity}, {kind: pins, parts: [top_corners]}]
"""
PINNED_CHAIN = """
mesh: {kind: network, positions: [[0, 0, 0], [1, 0, 0], [2, 0, 0]], springs: [[0, 1], [1, 2]], mass: [0, 0, 1]}
time_step: 1/30
frames: 3
effects:
  - {kind: springs, scaling_rule: fixed, stretch: 100}
  - {kind: gravity}
  - {kind: pins, indices: [0]}
"""


def rows_of(scene: str, tmp_path: Path, *, pairs: bool = False, **options: Any) -> list[dict[str, Any]]:
    """The rows of an ablation by local-global."""
    path = tmp_path / "scene.yaml"
    path.write_text(scene)
    sweep = load_config(path, solvers=["sparse"], threads=1, rounds=2, **options)
    return read_ablation(
        run_ablation(sweep, tmp_path, SilentDisplay(), lambda line: None, with_pairs=pairs, isolated=False)
    )


def by_name(rows: Sequence[dict[str, Any]], kind: str = "ablated") -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in rows if row["kind"] == kind}


@pytest.fixture(scope="module")
def ablation_rows(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    return rows_of(CLOTH, tmp_path_factory.mktemp("cloth"), pairs=True, max_iterations=20)


def test_every_effect_is_left_out_once_and_every_pair_on_request(tmp_path: Path):
    path = tmp_path / "scene.yaml"
    path.write_text(CLOTH + "  - {kind: pins, parts: [bottom]}\n")
    scene = load_scene(path)
    alone, both = build_variants(scene, with_pairs=False), build_variants(scene, with_pairs=True)
    assert [one.name for one in alone] == [
        "",
        "springs",
        "gravity",
        "bending",
        "air-drag",
        "pins[4]",
        "pins[5]",
    ]
    assert len(both) == 1 + 6 + 15
    assert [e.kind for e in both[7].scene.effects] == ["bending", "air-drag", "pins", "pins"]
    assert alone[0].scene.effects == scene.effects


def test_an_effect_that_does_nothing_costs_no_entry_and_moves_nothing(ablation_rows):
    (whole,), row = by_name(ablation_rows, "full-scene").values(), by_name(ablation_rows)["air-drag"]
    assert (
        row["displacement_max"],
        row["displacement_rms"],
        row["energy_difference"],
        row["centroid_displacement"],
    ) == (0.0, 0.0, 0.0, 0.0)
    assert row["nnz_factor"] == whole["nnz_factor"]
    assert "changes nothing at all" in describe_effect(row, ablation_rows)


def test_fill_in_and_memory_are_those_that_bending_brings(ablation_rows):
    (whole,), row = by_name(ablation_rows, "full-scene").values(), by_name(ablation_rows)["bending"]
    assert row["nnz_system"] < whole["nnz_system"]
    assert row["nnz_factor"] < whole["nnz_factor"]
    assert row["memory_bytes"] < whole["memory_bytes"]


def test_without_gravity_the_centre_of_mass_stays_where_it_was(ablation_rows):
    row = by_name(ablation_rows)["gravity"]
    (whole,) = by_name(ablation_rows, "full-scene").values()
    # It cannot fall further than freely, by g t^2/2 and the first order of implicit Euler: g t dt/2.
    t, spacing = 8 / 30, 0.25
    assert 0.0 < row["centroid_displacement"] <= 9.81 * t * (t + 1 / 30) / 2 / spacing
    assert row["displacement_max"] <= whole["bounding_box_diagonal"]
    assert row["energy_difference"] == pytest.approx(1.0)  # a scene without gravity and at rest has no energy at all


def test_pairs_are_reported_under_both_names(ablation_rows):
    assert {"gravity+bending", "springs+pins"} <= set(by_name(ablation_rows))
    # Without gravity nothing moves, and so bending has nothing to do.
    both, one = (by_name(ablation_rows)[name]["displacement_max"] for name in ("gravity+bending", "gravity"))
    assert both == pytest.approx(one, rel=1e-9)  # round-off of a step at rest


def test_a_scene_that_requires_an_effect_states_it(tmp_path: Path):
    ablation_rows = rows_of(PINNED_CHAIN, tmp_path, max_iterations=5)
    assert by_name(ablation_rows)["springs"]["status"] == "unsolvable"
    assert "impossible without it (" in describe_effect(by_name(ablation_rows)["springs"], ablation_rows)
    assert by_name(ablation_rows)["gravity"]["status"] == "ok"


def test_the_error_of_the_solver_falls_with_its_iterations_and_that_of_the_step_does_not(tmp_path: Path):
    few, many = (rows_of(SMALL_CLOTH, tmp_path, max_iterations=count) for count in (2, 500))
    before, after = (by_name(ablation_rows, "error") for ablation_rows in (few, many))
    assert after["solver"]["displacement_max"] < 1e-3 * before["solver"]["displacement_max"]
    assert after["time-step"]["displacement_max"] == pytest.approx(
        before["time-step"]["displacement_max"], rel=1e-6
    )  # both of Newton
    assert after["time-step"]["displacement_max"] > 0.01


def test_the_cost_is_the_difference_of_frames_that_were_timed_together():
    scene: Any = None
    rng = np.random.default_rng(1)
    drift = rng.uniform(1.0, 5.0, (5, 40))
    whole, without = (VariantRun(SceneVariant((), scene), seconds=(drift + more).tolist()) for more in (0.3, 0.0))
    assert compute_cost(whole, without) == pytest.approx((0.3, 0.3, 0.3))
    noisy = VariantRun(SceneVariant((), scene), seconds=(drift + 0.3 + 0.05 * rng.standard_normal((5, 40))).tolist())
    middle, low, high = compute_cost(noisy, without)
    assert low < middle < high
    # 40 frames, the median of 5 rounds each: the mean is known to 0.05 / sqrt(40 * 3), 0.005; six of these.
    assert middle == pytest.approx(0.3, abs=0.03)


WHOLE = {"kind": "full-scene", "name": "", "seconds": 1.0}
ERRORS = [
    {"kind": "error", "name": name, "status": "ok", "displacement_max": size}
    for name, size in (("solver", 0.3), ("time-step", 0.1))
]
ROW = {"kind": "ablated", "name": "bending", "status": "ok", "bounding_box_diagonal": 100.0, "displacement_max": 0.02}
ROW |= {"added_seconds": 0.11, "added_seconds_low": 0.1, "added_seconds_high": 0.12}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {},
            "11 % of the time, moves vertices by 0.02 rest lengths, less than the solver's own error of 0.3: "
            "this scene does not call for it at this accuracy",
        ),
        (
            {"displacement_max": 0.5},
            "11 % of the time, moves vertices by 0.5 rest lengths, more than the solver's own error of 0.3: "
            "this scene calls for it",
        ),
        ({"displacement_max": 0.0}, "11 % of the time, changes nothing at all: leave it out"),
        (
            {"displacement_max": 500.0},
            "11 % of the time, moves vertices by 500 rest lengths, further than the mesh is large: "
            "without it this is another scene",
        ),
        (
            {"displacement_max": 0.0, "added_seconds": 0.001, "added_seconds_low": -0.002, "added_seconds_high": 0.004},
            "no time that could be measured (-0.2 to +0.4 %), changes nothing at all: leave it out",
        ),
        ({"status": "unsolvable", "reason": "loose"}, "the scene is impossible without it (loose)"),
    ],
)
def test_the_verdict_follows_from_the_numbers(change: dict, said: str):
    assert describe_effect(ROW | change, [WHOLE, *ERRORS]) == said


def test_without_an_error_the_verdict_is_left_open():
    unknown = [row | {"status": "failed", "reason": "lost", "displacement_max": None} for row in ERRORS]
    assert describe_effect(ROW, [WHOLE, *unknown]).endswith("by how much the scene is wrong anyway is not known")
    assert "error of the solver: unknown (lost)" in summarise_ablation([WHOLE, *unknown])


@pytest.mark.usefixtures("without_workers")
def test_the_command_prints_its_results_and_writes_rows_and_a_picture(tmp_path: Path):
    for handler in list((log := logging.getLogger("springbench")).handlers):  # of another test, written elsewhere
        log.removeHandler(handler)
    (scene := tmp_path / "cloth.yaml").write_text(CLOTH)
    arguments = [
        "ablate",
        str(scene),
        "--results",
        str(tmp_path),
        "--frames",
        "4",
        "--rounds",
        "2",
        "--max-iterations",
        "5",
    ]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "air-drag: " in result.stderr
    assert "effects[3] (air-drag) does nothing with these parameters and is left out" in " ".join(result.stderr.split())
    (rows,) = tmp_path.glob("cloth/ablation/*.parquet")
    (picture,) = tmp_path.glob("cloth/pictures/*.png")
    assert len(read_ablation(rows)) >= 1 + 5 + 2
    assert {row["solver"] for row in read_ablation(rows)} == {DEFAULT_ABLATION_SOLVER}
    assert Image.open(picture).width == PAGE_WIDTH


def test_a_sweep_is_refused(tmp_path: Path):
    result = CliRunner().invoke(app, ["ablate", str(ROOT / "configs" / "quickstart.yaml"), "--results", str(tmp_path)])
    assert result.exit_code == 2
    assert "is a sweep" in result.stderr


def test_the_command_leaves_the_results_of_another_scene_of_this_name_alone(tmp_path: Path):
    for folder in ("one", "other"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "cloth.yaml").write_text(CLOTH)
    claim_folder(tmp_path / "results" / "cloth", tmp_path / "one" / "cloth.yaml")
    arguments = [
        "ablate",
        str(tmp_path / "other" / "cloth.yaml"),
        "--results",
        str(tmp_path / "results"),
        "--frames",
        "2",
    ]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "contains the results of another file of this name" in " ".join(result.stderr.split())
    assert not list(tmp_path.glob("results/cloth/ablation/*"))
