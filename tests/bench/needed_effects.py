"""Measure the displacement of vertices when an effect of a scene is left out, compared with the scene's own error.

    python -m tests.bench.needed_effects [SCENE ...] [--publish results/published/needed-effects]

Ten scenes are ablated (`springbench ablate`), at sizes that take seconds. The displacement of an effect is the largest
distance of a vertex from its position with all effects, in mean rest lengths. The scene's own error is the larger one
of the solver's error and the error of the time step. An effect is needed if its displacement exceeds that error.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from springbench.harness.cli.commands.ablate import DEFAULT_ABLATION_SOLVER, DEFAULT_ABLATION_TOLERANCE
from springbench.harness.config.config_loader import load_config
from springbench.harness.console import get_output_console
from springbench.harness.experiments.ablation.ablation_unit import run_ablation
from springbench.harness.report.ablation_summary import largest_known_error, read_ablation, select_kind

from tests.bench.scripted_study import describe_provenance, publish_rows
from tests.progress_displays import SilentDisplay

CONFIGS = Path(__file__).parents[2] / "configs"
SCENE_SIZES = {
    "scenes/hanging-cloth": 32,
    "scenes/flag-in-wind": 32,
    "scenes/pulled-curtain": 9,
    "scenes/cloth-on-sphere": 9,
    "scenes/net-catches-ball": 9,
    "scenes/inflated-balloon": 4,
    "scenes/tower": 12,
    "scenes/block-drop": 5,
    "touch/touching-curtain": 13,
    "touch/poncho": 24,
}


def measure_scene(name: str) -> list[dict[str, Any]]:
    """Ablate a scene, and return a row for each of its effects.

    Args:
        name: scene, relative to the folder of configs and without suffix.
    """
    options = {
        "solvers": [DEFAULT_ABLATION_SOLVER],
        "rtol": DEFAULT_ABLATION_TOLERANCE,
        "sizes": [SCENE_SIZES[name]],
        "rounds": 1,
        "threads": 1,
    }
    sweep = load_config(CONFIGS / f"{name}.yaml", **options)
    with TemporaryDirectory() as folder:
        path = run_ablation(sweep, Path(folder), SilentDisplay(), lambda line: None, with_pairs=False, isolated=False)
        rows = read_ablation(path)
    own_error, _ = largest_known_error(rows)
    (full_scene,) = select_kind(rows, "full-scene")
    return [
        {
            "scene": full_scene["scene"],
            "size": full_scene["size"],
            "effect": row["name"],
            "status": row["status"],
            "displacement_max": row["displacement_max"],
            "mesh_diagonal": row["bounding_box_diagonal"],
            "own_error": own_error,
        }
        for row in select_kind(rows, "ablated")
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("scenes", nargs="*", default=list(SCENE_SIZES), metavar="SCENE")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    table = Table("scene", "size", "own error", "without", "moves vertices by", box=SIMPLE_HEAD)
    for name in options.scenes:
        print(name, file=sys.stderr, flush=True)
        for row in measure_scene(name):
            rows.append(row)
            displacement = row["status"] if row["displacement_max"] is None else f"{row['displacement_max']:.2g}"
            table.add_row(row["scene"], str(row["size"]), f"{row['own_error']:.2g}", row["effect"], displacement)
    get_output_console().print(table)
    config = CONFIGS / "scenes" / "hanging-cloth.yaml"
    publish_rows(options.publish, config, rows, begin, is_timed=False)


if __name__ == "__main__":
    main()
