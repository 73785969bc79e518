"""Measure the time of an iteration with an effect over one without, for each effect and solver.

    python -m tests.bench.effects [--sizes 33] [--contact-sizes 33] [--rounds 3] [--frames 8] [--effects all]
        [--publish FOLDER] [SOLVER ...]

The hanging cloth is simulated with and without the effect, interleaved, to a tolerance of 1e-6 (see
`springbench.harness.experiments.ablation.iteration_overhead`). A cell has the ratio, the time of an iteration and the
limit of the ratio; the mark ! denotes a ratio above its limit. `--contact-sizes` adds idle contact of surfaces, by the
solvers of CONTACT_SOLVERS. These commands publish the studies of single effects and of all together:

    python -m tests.bench.effects --sizes 33 64 --contact-sizes 33 64 128 --publish results/published/prices
    python -m tests.bench.effects --effects all --publish results/published/all-effects
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from springbench.harness.config.config_loader import load_scene
from springbench.harness.console import print_message
from springbench.harness.execution.machine_info import limit_threads
from springbench.harness.experiments.ablation.iteration_overhead import measure_overhead, prepare_scene
from springbench.solvers.model.step_problem import StopRule, Unsupported
from springbench.solvers.registry import SOLVERS, load_target

from tests.bench.scripted_study import describe_provenance, publish_rows

CONFIGS = Path(__file__).parents[2] / "configs"
PRICES, CONTACT_PRICES = CONFIGS / "prices.yaml", CONFIGS / "prices-contact.yaml"
STOP = StopRule(5000, 1e-6)

DEFAULT_SOLVERS = ("newton", "hybrid", "newton-cg", "lbfgs", "vbd")
CONTACT_SOLVERS = ("newton", "hybrid", "lbfgs")
CHEAP, LINES, BENDING, IDLE, ALL = range(5)
KINDS = {
    "air-drag": CHEAP, "attachments": CHEAP, "wind": CHEAP, "contact": IDLE, "strain-limits": LINES,
    "dashpots": LINES, "rayleigh": LINES, "bending": BENDING, "all": ALL,
    "self-contact": IDLE, "surface-contact": IDLE,
}  # fmt: skip
CONTACT_EFFECTS = ["self-contact", "surface-contact"]
SINGLE_EFFECTS = [kind for kind in KINDS if kind not in (*CONTACT_EFFECTS, "all")]
LIMITS = {
    "newton": (1.05, 1.5, 3.0, 1.02, 4.0),
    "hybrid": (1.05, 1.4, 2.0, 1.02, 3.0),
    "newton-cg": (1.05, 1.4, 2.0, 1.02, 3.0),
    "lbfgs": (1.05, 1.6, 1.6, 1.02, 3.0),
    "vbd": (1.1, 1.5, 2.0, 1.1, 4.0),
}
"""Target of the ratio, by solver and by kind of effect."""

GATES = {
    "newton": (1.5, 2.0, 4.0, 1.3, 5.0),
    "hybrid": (1.5, 2.5, 3.0, 1.3, 6.0),
    "newton-cg": (1.5, 2.5, 3.0, 1.3, 6.0),
    "lbfgs": (1.5, 2.0, 3.0, 1.3, 5.5),
    "vbd": (1.5, 2.0, 3.0, 1.5, 10.0),
}
"""Largest ratio that the tests accept, by solver and by kind of effect, with a margin above the published ratios."""


def measure_cell(config: Path, size: int, effect: str, solver: str, frames: int, rounds: int) -> dict[str, Any]:
    """Measure an effect with a solver, and return its row; `refused` states why there is no ratio."""
    scene, made = load_scene(config), load_target(SOLVERS[solver])()
    row: dict[str, Any] = {"scene": config.stem, "size": size, "effect": effect, "solver": solver}
    try:
        both = prepare_scene(scene, size, made, effect), prepare_scene(scene, size, made)
        found = measure_overhead(effect, *both, STOP, initial_guess="previous", frames=frames, max_rounds=rounds)
    except Unsupported as error:
        return row | {"refused": str(error)}
    middle, low, high = found.ratio_interval
    row |= {"ratio": middle, "low": low, "high": high, "iteration_seconds": found.seconds, "refused": ""}
    return row | {"min_ratio": found.min_ratio, "rounds": found.num_rounds, "max_iterations": STOP.max_iterations}


def describe_cell(row: dict[str, Any]) -> str:
    """Format the table cell of a row."""
    if row["refused"]:
        return "refused"
    limit = LIMITS[row["solver"]][KINDS[row["effect"]]]
    mark = "" if row["ratio"] <= limit else " !"
    return f"{row['ratio']:.2f} ({1e3 * row['iteration_seconds']:.3g} ms; limit {limit:g}{mark})"


def main() -> None:
    """Print each effect when it is measured, then a table of each scene and size."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("solvers", nargs="*", default=DEFAULT_SOLVERS, metavar="SOLVER")
    for name, given in (("--rounds", 3), ("--frames", 8)):
        parser.add_argument(name, type=int, default=given)
    parser.add_argument("--sizes", type=int, nargs="*", default=[33])
    parser.add_argument("--contact-sizes", type=int, nargs="*", default=[])
    parser.add_argument("--effects", nargs="*", default=SINGLE_EFFECTS)
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    contact_solvers = [solver for solver in options.solvers if solver in CONTACT_SOLVERS]
    parts = [(PRICES, size, options.effects, options.solvers) for size in options.sizes]
    parts += [(CONTACT_PRICES, size, CONTACT_EFFECTS, contact_solvers) for size in options.contact_sizes]
    with limit_threads(1):
        for config, size, effects, solvers in parts:
            title = f"{config.stem}: an iteration with the effect over one without, {size} vertices a side"
            table = Table("effect", *solvers, box=SIMPLE_HEAD, title=title)
            for effect in effects:
                found = [measure_cell(config, size, effect, s, options.frames, options.rounds) for s in solvers]
                cells = [describe_cell(row) for row in found]
                table.add_row(effect, *cells)
                print_message(
                    f"{size} {effect}: {', '.join(f'{s} {cell}' for s, cell in zip(solvers, cells, strict=True))}"
                )
                rows += found
            Console(width=200).print(table)
    publish_rows(options.publish, PRICES, rows, begin)


if __name__ == "__main__":
    main()
