"""Measure errors relative to closed forms, and textile tests of five fabrics and of variants of them.

    python -m tests.bench.validation [CASE ...] [--publish results/published/validation]

The cases are those of `springbench validate`, simulated by Newton's method. A textile test passes if its value is in
the measured band. The drape test of each fabric is repeated with one change at a time: a finer mesh, a tenth of the
shear stiffness, and the smallest measured flexural rigidity.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from springbench.harness.experiments.validation.fabric_tests import DISC_SPACING, MeasuredBand, measure_drape
from springbench.harness.experiments.validation.validation_study import list_case_names, validate_solver
from springbench.harness.scenes.fabric_table import PUBLISHED_FABRICS, PublishedFabric
from springbench.solvers.methods.newton.newton_direct import NewtonSolver

from tests.bench.scripted_study import describe_provenance, publish_rows

FABRICS = Path(__file__).parents[2] / "harness" / "scenes" / "fabric_table.py"
"""File that states the measured fabrics."""
FINER_SPACING = 0.005
"""Spacing of mesh lines [m], a divisor of the disc's radii."""


def list_changes(fabric: PublishedFabric) -> dict[str, tuple[PublishedFabric, float]]:
    """Return the fabric and the spacing of mesh lines [m] of each change to the drape test, by its name."""
    return {
        "finer lines": (fabric, FINER_SPACING),
        "a tenth of the shear": (fabric._replace(shear=0.1 * fabric.shear), DISC_SPACING),
        "smallest rigidity": (fabric._replace(rigidity=fabric.rigidity_range[0]), DISC_SPACING),
    }


def measure_cases(names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield a row for each closed form, and for each bending length and drape coefficient of a fabric."""
    for name in names:
        (row,) = validate_solver(NewtonSolver(), [name])
        if row["kind"] == "closed form":
            copied = ("kind", "quantity", "exact", "explained_error", "observed_order", "order", "verdict")
            values = {"value": row["values"][-1], "error": row["errors"][-1]}
            yield {"case_name": name, **{key: row[key] for key in copied}, **values}
            continue
        fabric = name.removeprefix("fabric ")
        for quantity in ("bending_length", "drape_coefficient"):
            yield describe_band(fabric, quantity, "as tested", MeasuredBand(**row[quantity]))
        for change, (changed, spacing) in list_changes(PUBLISHED_FABRICS[fabric]).items():
            band, *_ = measure_drape(changed, NewtonSolver(), spacing)
            yield describe_band(fabric, "drape_coefficient", change, band)


def describe_band(fabric: str, quantity: str, change: str, band: MeasuredBand) -> dict[str, Any]:
    """Return the row of a textile test: its value and its band, in metres or percent."""
    return {
        "kind": "textile test",
        "case_name": fabric,
        "quantity": quantity,
        "change": change,
        "value": float(band.value),
        "low": float(band.low),
        "high": float(band.high),
        "verdict": "in band" if band.is_inside else "outside band",
    }


def main() -> None:
    """Print the rows."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("cases", nargs="*", default=list_case_names(), metavar="CASE")
    parser.add_argument("--publish", type=Path, help="folder of a published study")
    options = parser.parse_args()
    begin, rows = describe_provenance(), list[dict[str, Any]]()
    for row in measure_cases(options.cases):
        print(*(f"{value:.6g}" if isinstance(value, float) else value for value in row.values()), sep=", ", flush=True)
        rows.append(row)
    publish_rows(options.publish, FABRICS, rows, begin, is_timed=False)


if __name__ == "__main__":
    main()
