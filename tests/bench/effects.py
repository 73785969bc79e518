"""What an iteration costs with an effect, over one without: each effect by each solver, side by side.

    python -m tests.bench.effects [--size 33] [--rounds 3] [--frames 8] [--effects all] [--publish FOLDER] [SOLVER ...]

The hanging cloth is simulated to a tolerance of 1e-6 (see
`springbench.harness.experiments.ablation.iteration_overhead`). Each cell states the ratio, the time of an iteration and
the limit of the ratio. `--publish results/published/all-effects` is the study of all effects together.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.ablation.iteration_overhead import measure_overhead, prepare_scene
from springbench.solvers.model.step_problem import StopRule, Unsupported
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_moment, publish_rows

PRICES = Path(__file__).parents[2] / "configs" / "prices.yaml"
STOP = StopRule(5000, 1e-6)

SOLVED = ("newton", "hybrid", "newton-cg", "lbfgs", "vbd")
CHEAP, LINES, BENDING, IDLE, ALL = range(5)
KINDS = {
    "air-drag": CHEAP, "attachments": CHEAP, "wind": CHEAP, "contact": IDLE, "strain-limits": LINES,
    "dashpots": LINES, "rayleigh": LINES, "bending": BENDING, "all": ALL,
}  # fmt: skip
LIMITS = {
    "newton": (1.05, 1.5, 3.0, 1.02, 4.0),
    "hybrid": (1.05, 1.4, 2.0, 1.02, 3.0),
    "newton-cg": (1.05, 1.4, 2.0, 1.02, 3.0),
    "lbfgs": (1.05, 1.6, 1.6, 1.02, 3.0),
    "vbd": (1.1, 1.5, 2.0, 1.1, 4.0),
}
"""The goals, by solver and by kind of effect."""

GATES = {
    "newton": (1.5, 2.0, 4.0, 1.3, 5.0),
    "hybrid": (1.5, 2.5, 3.0, 1.3, 6.0),
    "newton-cg": (1.5, 2.5, 3.0, 1.3, 6.0),
    "lbfgs": (1.5, 2.5, 3.0, 1.3, 5.5),
    "vbd": (1.5, 4.0, 3.0, 1.5, 10.0),
}
"""What no price may reach, with room above what `results/README.md` has."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("solvers", nargs="*", default=SOLVED, metavar="SOLVER")
    for name, given in (("--size", 33), ("--rounds", 3), ("--frames", 8)):
        parser.add_argument(name, type=int, default=given)
    parser.add_argument("--effects", nargs="*", default=list(KINDS))
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_moment(), list[dict[str, Any]]()
    whole = load_scene(PRICES)
    table = Table(
        box=SIMPLE_HEAD, title=f"an iteration with the effect over one without, {options.size} vertices a side"
    )
    for heading in ("effect", *options.solvers):
        table.add_column(heading, justify="right")
    with limit_threads(1):
        for effect in options.effects:
            cells = []
            for solver in options.solvers:
                made = load_target(SOLVERS[solver])()
                try:
                    both = prepare_scene(whole, options.size, made, effect), prepare_scene(whole, options.size, made)
                    found = measure_overhead(effect, *both, STOP, frames=options.frames, max_rounds=options.rounds)
                except Unsupported:
                    cells.append("refused")
                    continue
                ratio, limit = found.ratio_interval.estimate, LIMITS[solver][KINDS[effect]]
                rows.append({"effect": effect, "solver": solver, "size": options.size, "time_ratio": ratio})
                beyond = "" if ratio <= limit else " !"
                cells.append(f"{ratio:.2f} ({1e3 * found.seconds:.3g} ms; limit {limit:g}{beyond})")
            table.add_row(effect, *cells)
    Console(width=200).print(table)
    command = f"python -m tests.bench.effects --size {options.size} --effects {' '.join(options.effects)}"
    publish_rows(options.publish, PRICES, command, rows, begin)


if __name__ == "__main__":
    main()
